// What the kernels' source files share: checked arrays in, the processor's best instructions, bands of rows in threads.
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <cstdint>
#include <exception>
#include <stdexcept>
#include <thread>
#include <vector>

// Put before a function: compiled for each of these, and the best one chosen when the module is loaded.
// Only what is inlined into such a function gains, hence SORVOLO_INLINE for its helpers.
#if defined(__x86_64__) && defined(__linux__) && (defined(__GNUC__) || defined(__clang__))
#define SORVOLO_CLONES __attribute__((target_clones("avx512bw", "avx2", "default")))
#else
#define SORVOLO_CLONES
#endif
#if defined(__GNUC__) || defined(__clang__)
#define SORVOLO_INLINE inline __attribute__((always_inline))
#else
#define SORVOLO_INLINE inline
#endif

namespace sorvolo {

// Arrays of another type or order are refused with a TypeError, never copied in silence: kernels/__init__.py is the
// place that converts. Name arguments with pybind11::arg("name").noconvert().
using Bytes = pybind11::array_t<std::uint8_t, pybind11::array::c_style>;
using Floats32 = pybind11::array_t<float, pybind11::array::c_style>;
using Integers64 = pybind11::array_t<std::int64_t, pybind11::array::c_style>;

// Calls work(first, last) for `threads` bands of the rows 0 .. rows - 1, at the same time. The GIL must be released.
template <typename Work>
void in_bands(int rows, int threads, Work work) {
    const int bands = std::max(1, std::min(threads, rows));
    std::vector<std::exception_ptr> failures(bands);
    auto run = [&](int band) {
        try {
            work(static_cast<int>(static_cast<std::int64_t>(rows) * band / bands),
                 static_cast<int>(static_cast<std::int64_t>(rows) * (band + 1) / bands));
        } catch (...) {
            failures[band] = std::current_exception();
        }
    };
    std::vector<std::thread> others;
    for (int band = 1; band < bands; ++band) others.emplace_back(run, band);
    run(0);
    for (auto &each : others) each.join();
    for (auto &failure : failures)
        if (failure) std::rethrow_exception(failure);
}

void bind_robust(pybind11::module_ &module);

}  // namespace sorvolo
