// How well photos agree, laid on level planes, and what heights cost along paths: see kernels/__init__.py.
#include "_native.hpp"

#include <pybind11/stl.h>

#include <cmath>
#include <limits>
#include <optional>

namespace sorvolo {

namespace {

using Doubles = pybind11::array_t<double, pybind11::array::c_style>;

constexpr double LEAST_DEPTH = 1e-6;  // nearer, and behind a camera, nothing is shown

struct View {
    const float *pictures;  // (channels, high, wide)
    int channels, high, wide;
    const double *level, *up;  // (3, 3) each: picture from cells at height 0, and what a metre of height adds
    const double *frame;       // left, top, right, bottom: where the photo ends
    const float *insets;       // of each side of a patch
    const float *hidden_below;  // (rows, columns), or null
};

struct Window {
    int rows, columns;
    std::ptrdiff_t cells() const { return static_cast<std::ptrdiff_t>(rows) * columns; }
};

// By value: what std::min and std::max take by reference is not done for many values at once.
template <typename T>
SORVOLO_INLINE T least(T a, T b) {
    return a < b ? a : b;
}
template <typename T>
SORVOLO_INLINE T most(T a, T b) {
    return a > b ? a : b;
}

// A row of cells on a plane: where the photo shows each, and how far within the photo that is; -1: it does not.
SORVOLO_CLONES
void lay(const View &view, double height, int row, int columns, float *u, float *v, float *within) {
    double plane[9];
    for (int k = 0; k < 9; ++k) plane[k] = view.level[k] + height * view.up[k];
    const double x0 = plane[1] * row + plane[2], y0 = plane[4] * row + plane[5], z0 = plane[7] * row + plane[8];
    const double left = view.frame[0], top = view.frame[1], right = view.frame[2], bottom = view.frame[3];
    SORVOLO_INDEPENDENT
    for (int c = 0; c < columns; ++c) {
        const double z = plane[6] * c + z0, depth = most(z, LEAST_DEPTH);
        const double x = (plane[0] * c + x0) / depth, y = (plane[3] * c + y0) / depth;
        const double across = least(x - left, right - x), along = least(y - top, bottom - y);
        u[c] = static_cast<float>(x);
        v[c] = static_cast<float>(y);
        within[c] = static_cast<float>(least(least(across, along), (z - LEAST_DEPTH) / LEAST_DEPTH));
    }
    if (view.hidden_below != nullptr) {
        const float *below = view.hidden_below + static_cast<std::ptrdiff_t>(row) * columns;
        const float own = static_cast<float>(height);
        for (int c = 0; c < columns; ++c) within[c] = own >= below[c] ? within[c] : -1.0f;
    }
}

// One channel between its pixels; 0 outside of it.
SORVOLO_CLONES
void sample(const float *picture, int high, int wide, const float *u, const float *v, int columns, float *out) {
    const float right = static_cast<float>(wide - 1), bottom = static_cast<float>(high - 1);
    SORVOLO_INDEPENDENT
    for (int c = 0; c < columns; ++c) {
        const float across = least(u[c], right - u[c]), along = least(v[c], bottom - v[c]);
        const float weight = least(across, along) >= 0 ? 1.0f : 0.0f;
        const float x = least(most(u[c], 0.0f), right), y = least(most(v[c], 0.0f), bottom);
        const int column = least(static_cast<int>(x), wide - 2), row = least(static_cast<int>(y), high - 2);
        const float dx = x - static_cast<float>(column), dy = y - static_cast<float>(row);
        const int at = row * wide + column;
        const float above = picture[at] + dx * (picture[at + 1] - picture[at]);
        const float below = picture[at + wide] + dx * (picture[at + wide + 1] - picture[at + wide]);
        out[c] = weight * (above + dy * (below - above));
    }
}

// The means of `side` x `side` cells around each of a plane, mirrored beyond its rims; below 0 they are 0.
SORVOLO_CLONES
void likeness(const float *plane, const Window &window, int side, float *sums, float *spare, float *down, float *out) {
    const int half = side / 2, columns = window.columns;
    const float share = 1.0f / static_cast<float>(side * side);
    const auto row = [&](int y) { return plane + static_cast<std::ptrdiff_t>(mirrored(y, window.rows)) * columns; };
    std::fill(down, down + columns, 0.0f);
    for (int y = -half; y <= half; ++y) add(down, row(y), columns, down);
    for (int y = 0; y < window.rows; ++y, out += columns) {
        padded(down, half, half, columns, sums);
        slide(sums, spare, side, columns, out);
        SORVOLO_INDEPENDENT
        for (int c = 0; c < columns; ++c) out[c] = std::max(out[c] * share, 0.0f);
        const float *next = row(y + half + 1), *last = row(y - half);
        SORVOLO_INDEPENDENT
        for (int c = 0; c < columns; ++c) down[c] += next[c] - last[c];
    }
}

SORVOLO_CLONES
void multiply(const float *a, const float *b, std::ptrdiff_t count, float *to) {
    SORVOLO_INDEPENDENT
    for (std::ptrdiff_t k = 0; k < count; ++k) to[k] = a[k] * b[k];
}

// Adds what is alike to a pair's total where both photos show the whole patch.
SORVOLO_CLONES
void take(const float *alike, const float *first, const float *second, float first_inset, float second_inset,
          std::ptrdiff_t count, float *total, float *sides) {
    SORVOLO_INDEPENDENT
    for (std::ptrdiff_t k = 0; k < count; ++k) {
        const bool both = first[k] >= first_inset && second[k] >= second_inset;
        total[k] += both ? alike[k] : 0.0f;
        sides[k] += both ? 1.0f : 0.0f;
    }
}

SORVOLO_CLONES
void per_side(float *total, const float *sides, std::ptrdiff_t count) {
    SORVOLO_INDEPENDENT
    for (std::ptrdiff_t k = 0; k < count; ++k)
        total[k] = sides[k] > 0 ? total[k] / std::max(sides[k], 1.0f) : -1.0f;
}

// The mean over the best `share` of the scores that are known (not -1); NaN where none is. The scores change places.
SORVOLO_CLONES
void better_mean(float *scores, int pairs, std::ptrdiff_t step, float share, int count, float *wanted, float *known,
                 float *out) {
    std::fill(known, known + count, 0.0f);
    std::fill(out, out + count, 0.0f);
    for (int k = 0; k < pairs; ++k) {
        const float *each = scores + k * step;
        SORVOLO_INDEPENDENT
        for (int c = 0; c < count; ++c) known[c] += each[c] >= 0 ? 1.0f : 0.0f;
    }
    for (int c = 0; c < count; ++c) wanted[c] = std::ceil(known[c] * share);
    const int most = static_cast<int>(std::ceil(static_cast<float>(pairs) * share));
    for (int rank = 0; rank < most; ++rank) {
        const int last = pairs - 1 - rank;
        for (int k = 0; k < last; ++k) {  // the largest of those left moves to their end
            float *lower = scores + k * step, *upper = lower + step;
            SORVOLO_INDEPENDENT
            for (int c = 0; c < count; ++c) {
                const float low = std::min(lower[c], upper[c]), high = std::max(lower[c], upper[c]);
                lower[c] = low;
                upper[c] = high;
            }
        }
        const float *largest = scores + last * step, at = static_cast<float>(rank);
        SORVOLO_INDEPENDENT
        for (int c = 0; c < count; ++c) out[c] += at < wanted[c] ? largest[c] : 0.0f;
    }
    constexpr float nothing = std::numeric_limits<float>::quiet_NaN();
    for (int c = 0; c < count; ++c) out[c] = known[c] > 0 ? out[c] / std::max(wanted[c], 1.0f) : nothing;
}

// What one thread needs for a plane.
class Plane {
public:
    Plane(const std::vector<View> &views, const std::int64_t *channel, const std::vector<int> &sides, float share,
          Window window)
        : views_(views), channel_(channel), sides_(sides), share_(share), window_(window),
          first_(views.size()), within_(views.size() * window.cells()) {
        std::size_t channels = 0;
        for (std::size_t k = 0; k < views.size(); ++k) {
            first_[k] = channels;
            channels += views[k].channels;
        }
        const std::size_t cells = window.cells(), pairs = views.size() * (views.size() - 1) / 2;
        const int widest = *std::max_element(sides.begin(), sides.end());
        laid_.resize(channels * cells);
        scores_.resize(pairs * cells);
        product_.resize(cells);
        alike_.resize(cells);
        counted_.resize(cells);
        line_.resize(3 * (static_cast<std::size_t>(window.columns) + 2 * widest));
    }

    // The agreement at a height, written row by row, `step` values from one row to the next.
    void at(double height, float *out, std::ptrdiff_t step) {
        const std::ptrdiff_t cells = window_.cells(), part = static_cast<std::ptrdiff_t>(line_.size()) / 3;
        const int columns = window_.columns, count = static_cast<int>(views_.size());
        float *u = line_.data(), *v = u + part, *third = v + part;
        std::vector<float> widest(views_.size(), -1.0f);
        for (int k = 0; k < count; ++k) {
            const View &view = views_[k];
            for (int y = 0; y < window_.rows; ++y) {
                const std::ptrdiff_t at = static_cast<std::ptrdiff_t>(y) * columns;
                float *within = within_.data() + k * cells + at;
                lay(view, height, y, columns, u, v, within);
                for (int c = 0; c < view.channels; ++c)
                    sample(view.pictures + static_cast<std::ptrdiff_t>(c) * view.high * view.wide, view.high,
                           view.wide, u, v, columns, laid_.data() + (first_[k] + c) * cells + at);
                widest[k] = std::max(widest[k], *std::max_element(within, within + columns));
            }
        }
        int pairs = 0;
        for (int i = 0; i < count; ++i)
            for (int j = i + 1; j < count; ++j) {
                float *score = scores_.data() + pairs * cells;
                bool is_seen = false;
                for (std::size_t s = 0; s < sides_.size(); ++s) {
                    if (widest[i] < views_[i].insets[s] || widest[j] < views_[j].insets[s]) continue;
                    if (!is_seen) {
                        std::fill(score, score + cells, 0.0f);
                        std::fill(counted_.begin(), counted_.end(), 0.0f);
                        multiply(of(i, j), of(j, i), cells, product_.data());
                    }
                    is_seen = true;
                    likeness(product_.data(), window_, sides_[s], u, v, third, alike_.data());
                    take(alike_.data(), within_.data() + i * cells, within_.data() + j * cells, views_[i].insets[s],
                         views_[j].insets[s], cells, score, counted_.data());
                }
                if (!is_seen) continue;
                per_side(score, counted_.data(), cells);
                ++pairs;
            }
        for (int y = 0; y < window_.rows; ++y, out += step)
            better_mean(scores_.data() + static_cast<std::ptrdiff_t>(y) * columns, pairs, cells, share_, columns, u,
                        v, out);
    }

private:
    const float *of(int view, int other) const {
        return laid_.data() + (first_[view] + channel_[view * views_.size() + other]) * window_.cells();
    }

    const std::vector<View> &views_;
    const std::int64_t *channel_;
    const std::vector<int> &sides_;
    float share_;
    Window window_;
    std::vector<std::size_t> first_;
    std::vector<float> within_, laid_, scores_, product_, alike_, counted_, line_;
};

Floats32 agreements(const std::vector<Floats32> &pictures, const Integers64 &channel, const Doubles &planes,
                    const Doubles &frames, const Floats32 &insets, const std::vector<std::optional<Floats32>> &hidden,
                    const Doubles &heights, const std::vector<int> &sides, int rows, int columns, float share,
                    int threads) {
    std::vector<View> views;
    for (std::size_t k = 0; k < pictures.size(); ++k)
        views.push_back({pictures[k].data(), static_cast<int>(pictures[k].shape(0)),
                         static_cast<int>(pictures[k].shape(1)), static_cast<int>(pictures[k].shape(2)),
                         planes.data(k, 0, 0, 0), planes.data(k, 1, 0, 0), frames.data(k, 0), insets.data(k, 0),
                         hidden[k] ? hidden[k]->data() : nullptr});
    const int levels = static_cast<int>(heights.shape(0));
    Floats32 result({rows, levels, columns});
    float *out = result.mutable_data();
    const double *height = heights.data();
    const std::int64_t *which = channel.data();
    pybind11::gil_scoped_release released;
    in_bands(levels, threads, [&](int first, int last) {
        Plane plane(views, which, sides, share, {rows, columns});
        for (int level = first; level < last; ++level)
            plane.at(height[level], out + static_cast<std::ptrdiff_t>(level) * columns,
                     static_cast<std::ptrdiff_t>(levels) * columns);
    });
    return result;
}

// A row of paths, `levels` x `columns`, that go on from `before`; the least of each is taken off so that sums stay small.
SORVOLO_CLONES
void go_on(const float *cost, const float *before, int levels, int columns, float one, float more, float *lowest,
           float *out) {
    std::memcpy(lowest, before, columns * sizeof(float));
    for (int d = 1; d < levels; ++d) {
        const float *each = before + static_cast<std::ptrdiff_t>(d) * columns;
        SORVOLO_INDEPENDENT
        for (int c = 0; c < columns; ++c) lowest[c] = least(lowest[c], each[c]);
    }
    for (int d = 0; d < levels; ++d, cost += columns, before += columns, out += columns) {
        const float *below = d > 0 ? before - columns : before, *above = d + 1 < levels ? before + columns : before;
        SORVOLO_INDEPENDENT
        for (int c = 0; c < columns; ++c) {
            const float step = least(below[c], above[c]) + one;
            out[c] = (least(least(before[c], lowest[c] + more), step) + cost[c]) - lowest[c];
        }
    }
}

SORVOLO_CLONES
void sum_up(const float *each, std::ptrdiff_t count, float *total) {
    add(total, each, static_cast<int>(count), total);
}

void shift(const float *before, int levels, int columns, int by, float *out) {
    for (int d = 0; d < levels; ++d, before += columns, out += columns)
        for (int c = 0; c < columns; ++c) out[c] = before[std::clamp(c - by, 0, columns - 1)];
}

// Adds the paths from row to row of a volume (rows, levels, columns), straight and, if asked for, from both sides too.
void add_paths(const float *cost, int rows, int levels, int columns, bool is_down, bool is_straight, float one,
               float more, float *total) {
    const std::ptrdiff_t row = static_cast<std::ptrdiff_t>(levels) * columns;
    const int ways = is_straight ? 1 : 3;
    std::vector<float> before(ways * row), shifted(row), after(row), lowest(columns);
    for (int k = 0; k < rows; ++k) {
        const std::ptrdiff_t at = (is_down ? k : rows - 1 - k) * row;
        for (int way = 0; way < ways; ++way) {
            float *own = before.data() + way * row;
            if (k == 0) {
                std::memcpy(own, cost + at, row * sizeof(float));
            } else {
                const float *from = own;
                if (way > 0) shift(own, levels, columns, way == 1 ? 1 : -1, shifted.data()), from = shifted.data();
                go_on(cost + at, from, levels, columns, one, more, lowest.data(), after.data());
                std::memcpy(own, after.data(), row * sizeof(float));
            }
            sum_up(own, row, total + at);
        }
    }
}

Floats32 path_costs(const Floats32 &cost, float one, float more) {
    const int rows = static_cast<int>(cost.shape(0)), levels = static_cast<int>(cost.shape(1)),
              columns = static_cast<int>(cost.shape(2));
    Floats32 result({rows, levels, columns});
    const float *from = cost.data();
    float *total = result.mutable_data();
    pybind11::gil_scoped_release released;
    const std::size_t count = static_cast<std::size_t>(rows) * levels * columns;
    std::fill(total, total + count, 0.0f);
    for (bool is_down : {true, false}) add_paths(from, rows, levels, columns, is_down, false, one, more, total);
    std::vector<float> turned(count), across(count, 0.0f);
    const auto each = [&](auto work) {
        for (int y = 0; y < rows; ++y)
            for (int d = 0; d < levels; ++d)
                for (int x = 0; x < columns; ++x)
                    work((static_cast<std::size_t>(y) * levels + d) * columns + x,
                         (static_cast<std::size_t>(x) * levels + d) * rows + y);
    };
    each([&](std::size_t own, std::size_t other) { turned[other] = from[own]; });
    for (bool is_down : {true, false})
        add_paths(turned.data(), columns, levels, rows, is_down, true, one, more, across.data());
    each([&](std::size_t own, std::size_t other) { total[own] += across[other]; });
    return result;
}

}  // namespace

void bind_heights(pybind11::module_ &module) {
    namespace py = pybind11;
    module.def("agreements", &agreements, py::arg("pictures"), py::arg("channel").noconvert(),
               py::arg("planes").noconvert(), py::arg("frames").noconvert(), py::arg("insets").noconvert(),
               py::arg("hidden"), py::arg("heights").noconvert(), py::arg("sides"), py::arg("rows"),
               py::arg("columns"), py::arg("share"), py::arg("threads"));
    module.def("path_costs", &path_costs, py::arg("cost").noconvert(), py::arg("one_level"), py::arg("more_levels"));
}

}  // namespace sorvolo
