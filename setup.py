"""The one thing that setup.cfg cannot say: the engine, which is left out only if one says so."""

import os
from glob import glob

from pybind11.setup_helpers import ParallelCompile, Pybind11Extension, build_ext
from setuptools import Extension, setup
from setuptools.errors import BaseError, CCompilerError

SANITIZERS = ["-fsanitize=address,undefined", "-fno-omit-frame-pointer", "-g", "-O1"]

# pip shows what a build says only if it fails: without this word a missing engine is a failure.
without_engine = os.environ.get("SB3_TORCS_WITHOUT_ENGINE") == "1"
sanitize = os.environ.get("SB3_TORCS_SANITIZE") == "1"

# No contraction into fused multiply-adds: the same numbers on every machine.
flags = ["-Wall", "-Wextra", "-ffp-contract=off"]
headers = sorted(glob("sb3_torcs/native/**/*.h", recursive=True))
maths = [f"sb3_torcs/native/maths/{name}.cpp" for name in ("as_glibc", "doubles", "rounded")]
engine = Pybind11Extension(
    "sb3_torcs._engine",
    [
        *sorted(glob("sb3_torcs/native/*.cpp")),
        *maths,
        "sb3_torcs/native/maths/check.cpp",
        "sb3_torcs/native/scr/messages.cpp",
    ],
    depends=headers,
    cxx_std=17,
    extra_compile_args=[*flags, *(SANITIZERS if sanitize else ["-O2"])],
    extra_link_args=["-ldl", "-pthread", *(SANITIZERS[:1] if sanitize else [])],
)


FAILED = """\

The engine of sb3-torcs, which drives Torcs-v0, cannot be built; see above why.

Get a C++17 compiler and Python's headers, and install again:
    sudo apt install g++ python3-dev
or install without the engine; TorcsLite-v0 needs none:
    SB3_TORCS_WITHOUT_ENGINE=1 pip install .
"""


class BuildEngine(build_ext):
    """Says what to type where the engine cannot be built."""

    def run(self) -> None:
        """Build; a mistake of the compiler ends the installation."""
        try:
            super().run()
        except (BaseError, CCompilerError) as error:
            raise SystemExit(f"{error}\n{FAILED}") from None


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
    )


game_libraries = [
    game_library(
        "_scr_server",
        "sb3_torcs/native/placing.cpp",
        "sb3_torcs/native/sensors.cpp",
        *maths,
        *sorted(glob("sb3_torcs/native/scr/*.cpp")),
    ),
    game_library("_game_maths", *maths, "sb3_torcs/native/maths/exports.cpp"),
    game_library("_game_window", *sorted(glob("sb3_torcs/native/window/*.cpp"))),
]

ParallelCompile(default=0).install()  # one compiler for each core

# Without any extension setuptools names a wheel py3-none-any.
extensions = [] if without_engine else [engine, *game_libraries]
setup(ext_modules=extensions, cmdclass={"build_ext": BuildEngine})
