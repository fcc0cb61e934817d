// Kernels of the robust change method.
//
// To add one: write it here in namespace sorvolo, SORVOLO_CLONES before the function with the hot loop, and bind it
// below with a pybind11::gil_scoped_release around that loop; declare it in _native.pyi, write the same function in
// NumPy in reference_robust.py, let __init__.py hand it on, and test that both agree. Then `pip install --no-deps -e .`.
#include "_native.hpp"

namespace sorvolo {

void bind_robust(pybind11::module_ &) {}

}  // namespace sorvolo
