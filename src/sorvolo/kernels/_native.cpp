// The compiled module, and the kernels of the thesis's change detection. reference.py is their specification.
#include "_native.hpp"

PYBIND11_MODULE(_native, module) {
    module.doc() = "The kernels, compiled; sorvolo.kernels is the door to them.";
    sorvolo::bind_robust(module);
}
