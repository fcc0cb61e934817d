// What two pictures differ by, row by row, so that everything stays in the cache. See tests/kernels/numpy_robust.py.
//
// Columns are counted by std::ptrdiff_t: where whole numbers may wrap (-fwrapv) loops over int are not vectorised.
#include "_native.hpp"

#include <pybind11/stl.h>

#include <cstddef>
#include <optional>

namespace sorvolo {

namespace {

SORVOLO_CLONES
void split_row(const std::uint8_t *bgr, std::uint8_t *blue, std::uint8_t *green, std::uint8_t *red,
               std::ptrdiff_t columns) {
    for (std::ptrdiff_t x = 0; x < columns; ++x)
        blue[x] = bgr[3 * x], green[x] = bgr[3 * x + 1], red[x] = bgr[3 * x + 2];
}

// The mean of 3 x 3; `sums` has one place before and one after the row, of which `columns` are the picture's.
SORVOLO_CLONES
void blur_row(const std::uint8_t *above, const std::uint8_t *here, const std::uint8_t *below, std::uint16_t *sums,
              std::uint8_t *to, std::ptrdiff_t columns, std::ptrdiff_t stride) {
    for (std::ptrdiff_t x = 0; x < stride; ++x)
        sums[x + 1] = static_cast<std::uint16_t>(above[x] + here[x] + below[x]);
    sums[0] = sums[2], sums[columns + 1] = sums[columns - 1];
    for (std::ptrdiff_t x = 0; x < stride; ++x) {
        const std::uint16_t sum = static_cast<std::uint16_t>(sums[x] + sums[x + 1] + sums[x + 2] + 4);
        to[x] = static_cast<std::uint8_t>((static_cast<std::uint32_t>(sum) * 7282u) >> 16);  // by nine
    }
}

// Blue, green and red become luma, red difference and blue difference, as OpenCV rounds them.
SORVOLO_CLONES
void luma_row(std::uint8_t *first, std::uint8_t *second, std::uint8_t *third, std::ptrdiff_t columns) {
    for (std::ptrdiff_t x = 0; x < columns; ++x) {
        const std::int32_t blue = first[x], green = second[x], red = third[x];
        const std::int32_t luma = (blue * 1868 + green * 9617 + red * 4899 + 8192) >> 14;
        const std::int32_t to_red = ((red - luma) * 11682 + (128 << 14) + 8192) >> 14;
        const std::int32_t to_blue = ((blue - luma) * 9241 + (128 << 14) + 8192) >> 14;
        first[x] = static_cast<std::uint8_t>(luma);
        second[x] = static_cast<std::uint8_t>(std::clamp(to_red, 0, 255));
        third[x] = static_cast<std::uint8_t>(std::clamp(to_blue, 0, 255));
    }
}

// The largest and the smallest of `window` neighbours, from rows that are padded by zeros and by 255.
SORVOLO_CLONES
void extremes_row(const std::uint8_t *low, const std::uint8_t *high, std::ptrdiff_t window, std::uint8_t *most,
                  std::uint8_t *least, std::ptrdiff_t columns) {
    std::memcpy(most, low, columns), std::memcpy(least, high, columns);
    for (std::ptrdiff_t by = 1; by < window; ++by) {
        for (std::ptrdiff_t x = 0; x < columns; ++x) {
            most[x] = std::max(most[x], low[x + by]);
            least[x] = std::min(least[x], high[x + by]);
        }
    }
}

SORVOLO_CLONES
void extremes_rows(const std::uint8_t *most, const std::uint8_t *least, std::uint8_t *all_most,
                   std::uint8_t *all_least, std::ptrdiff_t columns) {
    for (std::ptrdiff_t x = 0; x < columns; ++x) {
        all_most[x] = std::max(all_most[x], most[x]);
        all_least[x] = std::min(all_least[x], least[x]);
    }
}

SORVOLO_CLONES
void beyond_row(const std::uint8_t *values, const std::uint8_t *most, const std::uint8_t *least, std::uint8_t *to,
                std::ptrdiff_t columns) {
    for (std::ptrdiff_t x = 0; x < columns; ++x) {
        const std::uint8_t over = static_cast<std::uint8_t>(std::max(values[x], most[x]) - most[x]);
        const std::uint8_t under = static_cast<std::uint8_t>(least[x] - std::min(values[x], least[x]));
        to[x] = std::max(over, under);
    }
}

SORVOLO_CLONES
void weigh_row(const std::uint8_t *luma, const std::uint8_t *red, const std::uint8_t *blue, int weight,
               std::uint8_t *outside, std::uint8_t *chroma, std::ptrdiff_t columns) {
    const std::uint16_t by = static_cast<std::uint16_t>(weight);
    for (std::ptrdiff_t x = 0; x < columns; ++x) {
        const std::uint8_t colour = static_cast<std::uint8_t>(red[x] + std::min<std::uint8_t>(blue[x], 255 - red[x]));
        const std::uint16_t more = std::min<std::uint16_t>(static_cast<std::uint16_t>(colour * by), 255);
        chroma[x] = colour;
        const std::uint16_t total = static_cast<std::uint16_t>(more + luma[x]);
        outside[x] = static_cast<std::uint8_t>(std::min<std::uint16_t>(total, 255));
    }
}

SORVOLO_CLONES
void join_row(const std::uint8_t *a, const std::uint8_t *b, std::uint8_t *to, std::ptrdiff_t columns) {
    for (std::ptrdiff_t x = 0; x < columns; ++x) to[x] = std::max(a[x], b[x]);
}

SORVOLO_CLONES
void mask_row(const std::uint8_t *known, std::uint8_t *to, std::ptrdiff_t columns) {
    for (std::ptrdiff_t x = 0; x < columns; ++x) to[x] = known[x] ? to[x] : 0;
}

constexpr int LANES = 64;

// Rows are kept in whole lanes, the last of them holding anything: what is left over is slow to do one by one.
constexpr int in_lanes(int columns) { return (columns + LANES - 1) / LANES * LANES; }

// One picture's rows while they pass: split, then blurred and in luma, then their extremes along the row.
struct Passing {
    const std::uint8_t *image;
    int rows, columns, stride, reach, depth;
    std::vector<std::uint8_t> split, values, most, least, low, high;
    std::vector<std::uint16_t> sums;

    Passing(const std::uint8_t *pixels, int height, int width, int reach_px)
        : image(pixels), rows(height), columns(width), stride(in_lanes(width)), reach(reach_px),
          depth(2 * reach_px + 1), split(9 * stride), values(3 * depth * stride), most(3 * depth * stride),
          least(3 * depth * stride), low(stride + 2 * reach_px, 0), high(stride + 2 * reach_px, 255), sums(stride + 2) {
        split_at(0), split_at(1);
    }
    std::uint8_t *plane(std::vector<std::uint8_t> &ring, int row, int band) {
        return ring.data() + (static_cast<std::size_t>(row % depth) * 3 + band) * stride;
    }
    std::uint8_t *split_plane(int row, int band) {
        return split.data() + (static_cast<std::size_t>(row % 3) * 3 + band) * stride;
    }
    void split_at(int row) {
        split_row(image + static_cast<std::size_t>(row) * columns * 3, split_plane(row, 0), split_plane(row, 1),
                  split_plane(row, 2), columns);
    }
    void take(int row) {
        if (row >= 1 && row + 1 < rows) split_at(row + 1);
        const int above = mirrored(row - 1, rows), below = mirrored(row + 1, rows);
        for (int band = 0; band < 3; ++band)
            blur_row(split_plane(above, band), split_plane(row, band), split_plane(below, band), sums.data(),
                     plane(values, row, band), columns, stride);
        luma_row(plane(values, row, 0), plane(values, row, 1), plane(values, row, 2), stride);
        for (int band = 0; band < 3; ++band) {
            std::memcpy(low.data() + reach, plane(values, row, band), columns);
            std::memcpy(high.data() + reach, plane(values, row, band), columns);
            extremes_row(low.data(), high.data(), depth, plane(most, row, band), plane(least, row, band), stride);
        }
    }
    // The extremes of rows row - reach .. row + reach.
    void around(int row, int band, std::uint8_t *all_most, std::uint8_t *all_least) {
        const int first = std::max(row - reach, 0), last = std::min(row + reach, rows - 1);
        std::memcpy(all_most, plane(most, first, band), stride);
        std::memcpy(all_least, plane(least, first, band), stride);
        for (int each = first + 1; each <= last; ++each)
            extremes_rows(plane(most, each, band), plane(least, each, band), all_most, all_least, stride);
    }
};

void differences(const Bytes &reference, const Bytes &query, const std::optional<Bytes> &known, int reach, int weight,
                 Bytes &out) {
    const int rows = static_cast<int>(reference.shape(0)), columns = static_cast<int>(reference.shape(1));
    const std::uint8_t *pixels[2] = {reference.data(), query.data()};
    const std::uint8_t *compared = known ? known->data() : nullptr;
    std::uint8_t *to = out.mutable_data();
    pybind11::gil_scoped_release released;
    Passing before(pixels[0], rows, columns, reach), after(pixels[1], rows, columns, reach);
    const int stride = before.stride;
    std::vector<std::uint8_t> work(10 * static_cast<std::size_t>(stride));
    std::uint8_t *most = work.data(), *least = most + stride, *beyond = least + stride, *planes = beyond + 3 * stride;
    std::uint8_t *went_chroma = planes + 4 * stride;
    const std::size_t plane = static_cast<std::size_t>(rows) * columns;
    for (int row = 0; row < std::min(reach, rows); ++row) before.take(row), after.take(row);
    for (int row = 0; row < rows; ++row) {
        if (row + reach < rows) before.take(row + reach), after.take(row + reach);
        const auto outside = [&](Passing &values, Passing &others, std::uint8_t *total, std::uint8_t *chroma) {
            for (int band = 0; band < 3; ++band) {
                others.around(row, band, most, least);
                beyond_row(values.plane(values.values, row, band), most, least, beyond + band * stride, stride);
            }
            weigh_row(beyond, beyond + stride, beyond + 2 * stride, weight, total, chroma, stride);
        };
        outside(after, before, planes + 2 * stride, planes + stride);
        outside(before, after, planes + 3 * stride, went_chroma);
        join_row(planes + stride, went_chroma, planes + stride, stride);
        join_row(planes + 2 * stride, planes + 3 * stride, planes, stride);
        const std::size_t line = static_cast<std::size_t>(row) * columns;
        if (compared) mask_row(compared + line, planes, columns);
        for (int each = 0; each < 4; ++each) std::memcpy(to + each * plane + line, planes + each * stride, columns);
        std::memcpy(to + 4 * plane + line, before.plane(before.values, row, 0), columns);
        std::memcpy(to + 5 * plane + line, after.plane(after.values, row, 0), columns);
    }
}

}  // namespace

void bind_differences(pybind11::module_ &module) {
    using pybind11::arg;
    module.def("differences", &differences, arg("reference").noconvert(), arg("query").noconvert(),
               arg("known").noconvert(), arg("reach"), arg("weight"), arg("out").noconvert());
}

}  // namespace sorvolo
