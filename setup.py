"""The compiled kernels; everything else of the build is in pyproject.toml."""

import sys

from pybind11.setup_helpers import ParallelCompile, Pybind11Extension
from setuptools import setup

# No -march: the sources choose the processor's instructions at run time. No contraction: the same sums everywhere.
OPTIONS = ["/O2"] if sys.platform == "win32" else ["-O3", "-ffp-contract=off", "-pthread"]
LINKING = [] if sys.platform == "win32" else ["-pthread"]
FOLDER = "src/sorvolo/kernels"

native = Pybind11Extension(
    "sorvolo.kernels._native",
    [
        f"{FOLDER}/{name}.cpp"
        for name in ("_native", "_regions", "_robust", "_differences", "_light", "_heights")
    ],
    depends=[f"{FOLDER}/_native.hpp", "setup.py"],
    cxx_std=17,
    extra_compile_args=OPTIONS,
    extra_link_args=LINKING,
)

ParallelCompile(default=0).install()  # on all cores
setup(ext_modules=[native])
