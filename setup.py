"""The one thing that setup.cfg cannot say: the extension, which users may lack and CI may not."""

import os
from glob import glob

from pybind11.setup_helpers import Pybind11Extension, build_ext
from setuptools import Extension, setup

SANITIZERS = ["-fsanitize=address,undefined", "-fno-omit-frame-pointer", "-g", "-O1"]

required = os.environ.get("SB3_TORCS_REQUIRE_NATIVE") == "1"
sanitize = os.environ.get("SB3_TORCS_SANITIZE") == "1"

# No contraction into fused multiply-adds: the same numbers on every machine.
flags = ["-Wall", "-Wextra", "-ffp-contract=off"]
headers = sorted(glob("sb3_torcs/native/**/*.h", recursive=True))
engine = Pybind11Extension(
    "sb3_torcs._engine",
    [*sorted(glob("sb3_torcs/native/*.cpp")), "sb3_torcs/native/scr/messages.cpp"],
    depends=headers,
    cxx_std=17,
    extra_compile_args=[*flags, *(SANITIZERS if sanitize else ["-O2"])],
    extra_link_args=["-ldl", "-pthread", *(SANITIZERS[:1] if sanitize else [])],
    optional=not required,
)


def game_library(name: str, *sources: str) -> Extension:
    """
    Describe a library for the inside of the game's own process, which Python cannot import.

    :param name: of the file
    :param sources: of the C++
    """
    return Extension(
        f"sb3_torcs.{name}",
        list(sources),
        depends=headers,
        language="c++",
        extra_compile_args=["-std=c++17", "-O2", "-fvisibility=hidden", *flags],
        extra_link_args=["-ldl"],
        optional=not required,
    )


game_libraries = [
    game_library(
        "_scr_server",
        "sb3_torcs/native/placing.cpp",
        "sb3_torcs/native/sensors.cpp",
        *sorted(glob("sb3_torcs/native/scr/*.cpp")),
    ),
    game_library("_game_window", *sorted(glob("sb3_torcs/native/window/*.cpp"))),
]

setup(ext_modules=[engine, *game_libraries], cmdclass={"build_ext": build_ext})
