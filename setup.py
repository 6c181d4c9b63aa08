"""The one thing that setup.cfg cannot say: the extension, which users may lack and CI may not."""

import os
from glob import glob

from pybind11.setup_helpers import Pybind11Extension, build_ext
from setuptools import setup

SANITIZERS = ["-fsanitize=address,undefined", "-fno-omit-frame-pointer", "-g", "-O1"]

required = os.environ.get("SB3_TORCS_REQUIRE_NATIVE") == "1"
sanitize = os.environ.get("SB3_TORCS_SANITIZE") == "1"

# No contraction into fused multiply-adds: the same numbers on every machine.
flags = ["-Wall", "-Wextra", "-ffp-contract=off", *(SANITIZERS if sanitize else ["-O2"])]
engine = Pybind11Extension(
    "sb3_torcs._engine",
    sorted(glob("sb3_torcs/native/*.cpp")),
    depends=sorted(glob("sb3_torcs/native/*.h")),
    cxx_std=17,
    extra_compile_args=flags,
    extra_link_args=["-ldl", "-pthread", *(SANITIZERS[:1] if sanitize else [])],
    optional=not required,
)

setup(ext_modules=[engine], cmdclass={"build_ext": build_ext})
