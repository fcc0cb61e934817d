// Kernels on masks: isolated pixels, connected regions, what their boxes hold. reference.py is their specification.
#include "_native.hpp"

#include <pybind11/stl.h>

#include <cstring>
#include <optional>

namespace py = pybind11;

namespace sorvolo {
namespace {

struct Isolating {
    const std::uint8_t *mask;
    int rows, columns, width, height, least_white;
    std::uint8_t *out;
};

// The white pixels of each window by sums of columns that follow the window down, then by doubling along the row.
SORVOLO_CLONES void isolate_rows(const Isolating &work, int first, int last) {
    const int columns = work.columns, left = work.width / 2, right = work.width - 1 - left;
    const int above = work.height / 2, below = work.height - 1 - above;
    std::vector<std::uint16_t> sums(columns), wide(columns + work.width), spare(columns + work.width), out(columns);
    auto row_of = [&](int row) {
        return work.mask + static_cast<std::size_t>(mirrored(row, work.rows)) * columns;
    };
    for (int row = first - above; row < first + below; ++row) {
        const std::uint8_t *fresh = row_of(row);
        for (int x = 0; x < columns; ++x) sums[x] = static_cast<std::uint16_t>(sums[x] + (fresh[x] != 0));
    }
    for (int y = first; y < last; ++y) {
        const std::uint8_t *fresh = row_of(y + below), *gone = row_of(y - above);
        std::uint16_t *sum = sums.data();
        for (int x = 0; x < columns; ++x) sum[x] = static_cast<std::uint16_t>(sum[x] + (fresh[x] != 0));
        padded(sum, left, right, columns, wide.data());
        slide(wide.data(), spare.data(), work.width, columns, out.data());
        std::uint8_t *to = work.out + static_cast<std::size_t>(y) * columns;
        const std::uint16_t *white = out.data();
        const std::uint16_t least = static_cast<std::uint16_t>(work.least_white);
        for (int x = 0; x < columns; ++x) to[x] = white[x] >= least ? 255 : 0;
        for (int x = 0; x < columns; ++x) sum[x] = static_cast<std::uint16_t>(sum[x] - (gone[x] != 0));
    }
}

Bytes without_isolations(const Bytes &mask, int width, int height, int most_black, int threads) {
    Bytes kept({mask.shape(0), mask.shape(1)});
    const int least_white = std::max(0, width * height - most_black);
    const Isolating work{mask.data(), static_cast<int>(mask.shape(0)), static_cast<int>(mask.shape(1)), width, height,
                         least_white, kept.mutable_data()};
    py::gil_scoped_release released;
    in_bands(work.rows, threads, [&](int first, int last) { isolate_rows(work, first, last); });
    return kept;
}

struct Run {
    int from, to;  // columns from .. to - 1
    std::int32_t label;
};

struct Labels {
    std::vector<std::int32_t> parent;
    std::vector<std::int64_t> boxes;  // left, top, right, bottom, the last two excluded

    std::int32_t root(std::int32_t label) {
        while (parent[label] != label) label = parent[label] = parent[parent[label]];
        return label;
    }
    void join(std::int32_t a, std::int32_t b) {  // the smaller label was met first, and stays
        a = root(a), b = root(b);
        parent[std::max(a, b)] = std::min(a, b);
    }
};

void find_runs(const std::uint8_t *row, int columns, std::vector<Run> &runs) {
    runs.clear();
    std::uint64_t eight;
    for (int x = 0; x < columns;) {
        for (; x + 8 <= columns; x += 8) {
            std::memcpy(&eight, row + x, 8);
            if (eight) break;
        }
        while (x < columns && !row[x]) ++x;
        if (x == columns) break;
        const int from = x;
        while (x < columns && row[x]) {
            if (x + 8 <= columns) {
                std::memcpy(&eight, row + x, 8);
                if (eight == ~0ull) {
                    x += 8;
                    continue;
                }
            }
            ++x;
        }
        runs.push_back({from, x, -1});
    }
}

Integers64 region_boxes(const Bytes &mask) {
    const int rows = static_cast<int>(mask.shape(0)), columns = static_cast<int>(mask.shape(1));
    const std::uint8_t *pixels = mask.data();
    Labels labels;
    std::vector<std::int64_t> found;
    {
        py::gil_scoped_release released;
        std::vector<Run> above, here;
        for (int y = 0; y < rows; ++y) {
            find_runs(pixels + static_cast<std::size_t>(y) * columns, columns, here);
            std::size_t candidate = 0;
            for (Run &run : here) {
                while (candidate < above.size() && above[candidate].to < run.from) ++candidate;
                for (std::size_t i = candidate; i < above.size() && above[i].from <= run.to; ++i) {
                    if (run.label < 0) run.label = above[i].label;
                    else labels.join(run.label, above[i].label);
                }
                if (run.label < 0) {
                    run.label = static_cast<std::int32_t>(labels.parent.size());
                    labels.parent.push_back(run.label);
                    labels.boxes.insert(labels.boxes.end(), {run.from, y, run.to, y + 1});
                }
                std::int64_t *box = labels.boxes.data() + 4 * static_cast<std::size_t>(run.label);
                box[0] = std::min<std::int64_t>(box[0], run.from);
                box[2] = std::max<std::int64_t>(box[2], run.to);
                box[3] = y + 1;
            }
            above.swap(here);
        }
        const std::int32_t count = static_cast<std::int32_t>(labels.parent.size());
        for (std::int32_t label = count - 1; label >= 0; --label) {  // parents are smaller: children come first
            const std::int32_t parent = labels.parent[label];
            if (parent == label) continue;
            std::int64_t *into = labels.boxes.data() + 4 * static_cast<std::size_t>(parent);
            const std::int64_t *from = labels.boxes.data() + 4 * static_cast<std::size_t>(label);
            into[0] = std::min(into[0], from[0]);
            into[1] = std::min(into[1], from[1]);
            into[2] = std::max(into[2], from[2]);
            into[3] = std::max(into[3], from[3]);
        }
        for (std::int32_t label = 0; label < count; ++label) {
            if (labels.parent[label] != label) continue;
            const std::int64_t *box = labels.boxes.data() + 4 * static_cast<std::size_t>(label);
            found.insert(found.end(), {box[0], box[1], box[2] - box[0], box[3] - box[1]});
        }
    }
    Integers64 boxes({static_cast<py::ssize_t>(found.size() / 4), static_cast<py::ssize_t>(4)});
    std::copy(found.begin(), found.end(), boxes.mutable_data());
    return boxes;
}

// Each run of columns of `mask` is a part of its own at first, and joins those that it touches in the row above.
Bytes held_parts(const Bytes &mask, const Bytes &seeds) {
    const int rows = static_cast<int>(mask.shape(0)), columns = static_cast<int>(mask.shape(1));
    const std::uint8_t *pixels = mask.data(), *seed = seeds.data();
    Bytes kept({mask.shape(0), mask.shape(1)});
    std::uint8_t *out = kept.mutable_data();
    py::gil_scoped_release released;
    std::memset(out, 0, static_cast<std::size_t>(rows) * columns);
    Labels labels;
    std::vector<std::uint8_t> is_held;
    std::vector<std::vector<Run>> runs(rows);
    std::vector<Run> seeded;
    for (int y = 0; y < rows; ++y) {
        find_runs(pixels + static_cast<std::size_t>(y) * columns, columns, runs[y]);
        find_runs(seed + static_cast<std::size_t>(y) * columns, columns, seeded);
        std::size_t above = 0, next = 0;
        for (Run &run : runs[y]) {
            run.label = static_cast<std::int32_t>(labels.parent.size());
            labels.parent.push_back(run.label);
            while (next < seeded.size() && seeded[next].to <= run.from) ++next;
            is_held.push_back(next < seeded.size() && seeded[next].from < run.to);
            if (y == 0) continue;
            while (above < runs[y - 1].size() && runs[y - 1][above].to <= run.from) ++above;
            for (std::size_t i = above; i < runs[y - 1].size() && runs[y - 1][i].from < run.to; ++i)
                labels.join(run.label, runs[y - 1][i].label);
        }
    }
    for (std::size_t label = 0; label < is_held.size(); ++label)
        if (is_held[label]) is_held[labels.root(static_cast<std::int32_t>(label))] = 1;
    for (int y = 0; y < rows; ++y)
        for (const Run &run : runs[y])
            if (is_held[labels.root(run.label)])
                std::memset(out + static_cast<std::size_t>(y) * columns + run.from, 255, run.to - run.from);
    return kept;
}

Integers64 gray_histograms(const Bytes &image, const Bytes &tables, const Integers64 &boxes,
                           const std::optional<Bytes> &known) {
    const py::ssize_t columns = image.shape(1), count = boxes.shape(0);
    Integers64 histograms({count, static_cast<py::ssize_t>(256)});
    std::int64_t *out = histograms.mutable_data();
    const std::uint8_t *pixels = image.data(), *table = tables.data();
    const std::int64_t *box = boxes.data();
    const std::uint8_t *counted = known ? known->data() : nullptr;
    py::gil_scoped_release released;
    std::int32_t weighted[3][256];
    for (int value = 0; value < 256; ++value) {
        weighted[0][value] = table[value] * BLUE + GRAY_HALF;
        weighted[1][value] = table[256 + value] * GREEN;
        weighted[2][value] = table[512 + value] * RED;
    }
    for (py::ssize_t i = 0; i < count; ++i, box += 4, out += 256) {
        std::uint32_t parts[4][256] = {};
        for (std::int64_t y = box[1]; y < box[1] + box[3]; ++y) {
            const std::uint8_t *pixel = pixels + 3 * (y * columns + box[0]);
            const std::uint8_t *counts = counted ? counted + y * columns + box[0] : nullptr;
            auto gray = [&](std::int64_t x) {
                const std::uint8_t *at = pixel + 3 * x;
                return (weighted[0][at[0]] + weighted[1][at[1]] + weighted[2][at[2]]) >> GRAY_SHIFT;
            };
            std::int64_t x = 0;
            for (; !counts && x + 4 <= box[2]; x += 4)
                for (int k = 0; k < 4; ++k) ++parts[k][gray(x + k)];
            for (; x < box[2]; ++x)
                if (!counts || counts[x]) ++parts[x & 3][gray(x)];
        }
        for (int value = 0; value < 256; ++value)
            out[value] = static_cast<std::int64_t>(parts[0][value]) + parts[1][value] + parts[2][value] +
                         parts[3][value];
    }
    return histograms;
}

}  // namespace

void bind_regions(py::module_ &module) {
    auto array = [](const char *name) { return py::arg(name).noconvert(); };
    module.def("without_isolations", &without_isolations, array("mask"), py::arg("width"), py::arg("height"),
               py::arg("most_black"), py::arg("threads"));
    module.def("region_boxes", &region_boxes, array("mask"));
    module.def("held_parts", &held_parts, array("mask"), array("seeds"));
    module.def("gray_histograms", &gray_histograms, array("image"), array("tables"), array("boxes"),
               array("known"));
}

}  // namespace sorvolo
