// What the kernels' source files share: checked arrays in, the processor's best instructions, bands of rows in threads.
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <exception>
#include <stdexcept>
#include <thread>
#include <vector>

#if defined(__x86_64__) && (defined(__GNUC__) || defined(__clang__))
#define SORVOLO_X86 1
#define SORVOLO_AVX512 __attribute__((target("avx512f,avx512bw,avx512vl,avx512dq,avx2,bmi,bmi2")))
#define SORVOLO_AVX2 __attribute__((target("avx2,bmi,bmi2")))
#endif
#if defined(__GNUC__) || defined(__clang__)
#define SORVOLO_INLINE inline __attribute__((always_inline))
#else
#define SORVOLO_INLINE inline
#endif

#if defined(__clang__)
#define SORVOLO_INDEPENDENT _Pragma("clang loop vectorize(assume_safety)")
#elif defined(__GNUC__)
#define SORVOLO_INDEPENDENT _Pragma("GCC ivdep")
#else
#define SORVOLO_INDEPENDENT
#endif

// Put before a function: compiled for each of these, and the best one chosen when the module is loaded. Only what is
// inlined into such a function gains, hence SORVOLO_INLINE for its helpers. Needs the loader of glibc.
#if defined(SORVOLO_X86) && defined(__GLIBC__) && __GNUC__ >= 12
#define SORVOLO_CLONES __attribute__((target_clones("arch=x86-64-v4", "avx2", "default")))
#elif defined(SORVOLO_X86) && defined(__GLIBC__)
#define SORVOLO_CLONES __attribute__((target_clones("avx2", "default")))
#else
#define SORVOLO_CLONES
#endif

namespace sorvolo {

// Arrays of another type or order are refused with a TypeError, never copied in silence: kernels/__init__.py is the
// place that converts. Name arguments with pybind11::arg("name").noconvert().
using Bytes = pybind11::array_t<std::uint8_t, pybind11::array::c_style>;
using Floats32 = pybind11::array_t<float, pybind11::array::c_style>;
using Integers64 = pybind11::array_t<std::int64_t, pybind11::array::c_style>;

enum class Instructions { plain, avx2, avx512 };

// The best that both the processor and `SORVOLO_INSTRUCTIONS` (plain, avx2; for tests) allow; asked once.
Instructions instructions();

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

// Gray of BGR as in ITU-R BT.601, in whole numbers.
constexpr int BLUE = 3735, GREEN = 19235, RED = 9798, GRAY_HALF = 16384, GRAY_SHIFT = 15;

// Where position `at` of an endlessly mirrored row of `size` pixels lies; the rim itself is not repeated.
SORVOLO_INLINE int mirrored(int at, int size) {
    if (size == 1) return 0;
    const int period = 2 * size - 2;
    at = ((at % period) + period) % period;
    return at < size ? at : period - at;
}

// to[x] = a[x] + b[x]: apart, so that the compiler sees that nothing else is touched.
template <typename Sum>
SORVOLO_INLINE void add(const Sum *a, const Sum *b, int count, Sum *to) {
    SORVOLO_INDEPENDENT
    for (int x = 0; x < count; ++x) to[x] = static_cast<Sum>(a[x] + b[x]);
}

// The sums of `width` neighbours: out[x] = sums[x] + ... + sums[x + width - 1]; doubling needs few additions.
// `sums` and `spare` hold columns + width - 1 values and are used up.
template <typename Sum>
SORVOLO_INLINE void slide(Sum *sums, Sum *spare, int width, int columns, Sum *out) {
    int done = 0;
    for (int bit = 1; bit <= width; bit *= 2) {
        if (width & bit) {
            if (done == 0) std::memcpy(out, sums, columns * sizeof(Sum));
            else add(out, sums + done, columns, out);
            done += bit;
        }
        if (2 * bit > width) break;
        add(sums, sums + bit, columns + width - 2 * bit, spare);
        std::swap(sums, spare);
    }
}

template <typename Sum>
SORVOLO_INLINE void padded(const Sum *row, int before, int after, int columns, Sum *out) {
    for (int x = -before; x < 0; ++x) out[x + before] = row[mirrored(x, columns)];
    std::memcpy(out + before, row, columns * sizeof(Sum));
    for (int x = columns; x < columns + after; ++x) out[x + before] = row[mirrored(x, columns)];
}

void bind_regions(pybind11::module_ &module);
void bind_robust(pybind11::module_ &module);
void bind_differences(pybind11::module_ &module);
void bind_light(pybind11::module_ &module);
void bind_heights(pybind11::module_ &module);

}  // namespace sorvolo
