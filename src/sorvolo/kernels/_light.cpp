// Kernels of the light between two pictures and of their last pixels of alignment. See tests/kernels/numpy_light.py.
#include "_native.hpp"

#include <cmath>
#include <cstddef>

namespace sorvolo {

namespace {

using Doubles = pybind11::array_t<double, pybind11::array::c_style>;

// The middle one of values, of an even number the mean of the middle two; the values are put into another order.
template <typename Value>
Value median_of(Value *values, std::ptrdiff_t count) {
    Value *const half = values + count / 2;
    std::nth_element(values, half, values + count);
    if (count % 2) return *half;
    return (*std::max_element(values, half) + *half) / Value(2);
}

// As above for floats that are not negative: their bits count up as they do, so that few need to be put into order.
float median_of_lengths(const float *values, std::ptrdiff_t count, std::vector<float> &work) {
    constexpr int SHIFT = 19, BINS = 1 << 12;
    std::uint16_t bins[BINS] = {};
    const auto bin_of = [](float value) {
        std::uint32_t bits;
        std::memcpy(&bits, &value, 4);
        return bits >> SHIFT;
    };
    if (count > 65535) {
        work.assign(values, values + count);
        return median_of(work.data(), count);
    }
    for (std::ptrdiff_t at = 0; at < count; ++at) ++bins[bin_of(values[at])];
    // the two middle ones lie in bins first .. last, behind `before` others
    const std::ptrdiff_t low = (count - 1) / 2, high = count / 2;
    std::ptrdiff_t before = 0, first = 0;
    for (; before + bins[first] <= low; ++first) before += bins[first];
    std::ptrdiff_t last = first;
    for (std::ptrdiff_t sum = before + bins[first]; sum <= high;) sum += bins[++last];
    work.clear();
    for (std::ptrdiff_t at = 0; at < count; ++at) {
        const std::ptrdiff_t bin = bin_of(values[at]);
        if (bin >= first && bin <= last) work.push_back(values[at]);
    }
    float *const one = work.data() + (low - before);
    std::nth_element(work.data(), one, work.data() + work.size());
    if (low == high) return *one;
    return (*one + *std::min_element(one + 1, work.data() + work.size())) / 2.0f;
}

SORVOLO_CLONES
void rest_of(const float *before, const float *after, float slope, float *rest, float *lengths, std::ptrdiff_t count) {
    for (std::ptrdiff_t at = 0; at < count; ++at) {
        rest[at] = after[at] - slope * before[at];
        lengths[at] = std::abs(rest[at]);
    }
}

// Sums in eight lanes, so that they can be added at once and yet in one order everywhere.
constexpr int LANES = 8;

SORVOLO_CLONES
void spreads_of(const float *before, const float *after, const float *rest, float scale, double *sums,
                std::ptrdiff_t count) {
    double one[LANES] = {}, other[LANES] = {};
    const auto add = [&](std::ptrdiff_t at, int lane) {
        const float off = rest[at] / scale;
        const double weight = 1.0f / (1.0f + off * off), a = before[at], b = after[at];
        one[lane] += weight * a * a, other[lane] += weight * b * b;
    };
    std::ptrdiff_t at = 0;
    for (; at + LANES <= count; at += LANES)
        for (int lane = 0; lane < LANES; ++lane) add(at + lane, lane);
    for (; at < count; ++at) add(at, 0);
    sums[0] = sums[1] = 0;
    for (int lane = 0; lane < LANES; ++lane) sums[0] += one[lane], sums[1] += other[lane];
}

Doubles slopes(const Floats32 &before, const Floats32 &after, double prior) {
    const std::ptrdiff_t count = before.shape(0), channels = before.shape(1);
    Doubles found({static_cast<pybind11::ssize_t>(channels)});
    const float *from = before.data(), *to = after.data();
    double *slope = found.mutable_data();
    pybind11::gil_scoped_release released;
    std::vector<float> work, values(4 * static_cast<std::size_t>(count));
    float *a = values.data(), *b = a + count, *rest = b + count, *lengths = rest + count;
    for (std::ptrdiff_t channel = 0; channel < channels; ++channel) {
        for (std::ptrdiff_t at = 0; at < count; ++at) {
            a[at] = from[at * channels + channel], b[at] = to[at * channels + channel];
            rest[at] = 0.0f;  // at first all weigh the same
        }
        double sums[2], scale = 1.0;
        for (int round = 0; round < 4; ++round) {
            if (round > 0) {
                rest_of(a, b, static_cast<float>(slope[channel]), rest, lengths, count);
                scale = std::max(1.5 * static_cast<double>(median_of_lengths(lengths, count, work)), 0.01);
            }
            spreads_of(a, b, rest, static_cast<float>(scale), sums, count);
            slope[channel] = std::sqrt((sums[1] + prior) / (sums[0] + prior));
        }
    }
    return found;
}

constexpr int TERMS = 8;

// Adds up the weighted normal equations of one direction: rows are `TERMS` long, `right` belongs to the rows' moves.
SORVOLO_CLONES
void add_normal(const double *rows, const double *moves, const double *weights, std::ptrdiff_t count, double *normal,
                double *right) {
    double products[TERMS][TERMS] = {}, sums[TERMS] = {};  // near at hand while they grow
    for (std::ptrdiff_t at = 0; at < count; ++at) {
        double row[TERMS], weighted[TERMS];
        std::memcpy(row, rows + at * TERMS, sizeof row);
        for (int i = 0; i < TERMS; ++i) weighted[i] = weights[at] * row[i];
        for (int j = 0; j < TERMS; ++j) {
            for (int i = 0; i < TERMS; ++i) products[j][i] += weighted[i] * row[j];
            sums[j] += weighted[j] * moves[2 * at];
        }
    }
    for (int j = 0; j < TERMS; ++j) {
        for (int i = 0; i < TERMS; ++i) normal[j * TERMS + i] += products[j][i];
        right[j] += sums[j];
    }
}

// Solves a positive definite system in place of `right`, by Cholesky.
void solve(double *normal, double *right) {
    for (int j = 0; j < TERMS; ++j) {
        for (int i = j; i < TERMS; ++i) {
            double value = normal[i * TERMS + j];
            for (int k = 0; k < j; ++k) value -= normal[i * TERMS + k] * normal[j * TERMS + k];
            normal[i * TERMS + j] = i == j ? std::sqrt(value) : value / normal[j * TERMS + j];
        }
    }
    for (int i = 0; i < TERMS; ++i) {
        for (int k = 0; k < i; ++k) right[i] -= normal[i * TERMS + k] * right[k];
        right[i] /= normal[i * TERMS + i];
    }
    for (int i = TERMS - 1; i >= 0; --i) {
        for (int k = i + 1; k < TERMS; ++k) right[i] -= normal[k * TERMS + i] * right[k];
        right[i] /= normal[i * TERMS + i];
    }
}

SORVOLO_CLONES
void lengths_left(const double *rows_x, const double *rows_y, const double *moves, const double *solution, double wide,
                  double high, double *rest, std::ptrdiff_t count) {
    for (std::ptrdiff_t at = 0; at < count; ++at) {
        double x = 0, y = 0;
        for (int i = 0; i < TERMS; ++i) {
            x += rows_x[at * TERMS + i] * solution[i];
            y += rows_y[at * TERMS + i] * solution[i];
        }
        x = (moves[2 * at] - x) * wide, y = (moves[2 * at + 1] - y) * high;
        rest[at] = std::sqrt(x * x + y * y);
    }
}

pybind11::tuple fit_moves(const Doubles &rows_x, const Doubles &rows_y, const Doubles &moves, const Doubles &trust,
                          const Doubles &ridge, double wide, double high) {
    const std::ptrdiff_t count = trust.shape(0);
    Doubles solution({pybind11::ssize_t(TERMS)});
    double *fit = solution.mutable_data(), middle = 0;
    const double *in_x = rows_x.data(), *in_y = rows_y.data(), *move = moves.data(), *trusted = trust.data();
    const double *damping = ridge.data();
    {
        pybind11::gil_scoped_release released;
        std::vector<double> weights(trusted, trusted + count), rest(count), work;
        for (int round = 0; round < 4; ++round) {
            double normal[TERMS * TERMS] = {}, total = 0;
            std::fill(fit, fit + TERMS, 0.0);
            for (const double each : weights) total += each;
            for (int i = 0; i < TERMS; ++i) normal[i * TERMS + i] = total * damping[i];
            add_normal(in_x, move, weights.data(), count, normal, fit);
            add_normal(in_y, move + 1, weights.data(), count, normal, fit);
            solve(normal, fit);
            lengths_left(in_x, in_y, move, fit, wide, high, rest.data(), count);
            work.clear();
            for (std::ptrdiff_t at = 0; at < count; ++at)
                if (trusted[at] > 0) work.push_back(rest[at]);
            middle = median_of(work.data(), static_cast<std::ptrdiff_t>(work.size()));
            const double scale = std::max(1.5 * middle, 0.05);
            for (std::ptrdiff_t at = 0; at < count; ++at) {
                const double off = rest[at] / scale;
                weights[at] = trusted[at] / (1 + off * off);
            }
        }
    }
    return pybind11::make_tuple(solution, middle);
}

// The details of one row of logarithms: less the mean around, whose sums over the rows of a window are `columns`.
SORVOLO_CLONES
void detail_row(const float *row, const double *columns, int window, double share, double *work, double *spare,
                double *sums, float *to, std::ptrdiff_t width) {
    std::memcpy(work, columns, static_cast<std::size_t>(width + window - 1) * sizeof(double));
    slide(work, spare, window, static_cast<int>(width), sums);
    for (std::ptrdiff_t x = 0; x < width; ++x) to[x] = row[x] - static_cast<float>(sums[x] * share);
}

SORVOLO_CLONES
void add_row(const float *fresh, const float *gone, double *columns, std::ptrdiff_t width) {
    if (gone)
        for (std::ptrdiff_t x = 0; x < width; ++x) columns[x] += static_cast<double>(fresh[x]) - gone[x];
    else
        for (std::ptrdiff_t x = 0; x < width; ++x) columns[x] += fresh[x];
}

SORVOLO_CLONES
void add_products(const float *a, const float *b, float *both, float *one, float *other, std::ptrdiff_t width) {
    for (std::ptrdiff_t x = 0; x < width; ++x)
        both[x] += a[x] * b[x], one[x] += a[x] * a[x], other[x] += b[x] * b[x];
}

// One picture's rows of details while they pass.
struct Details {
    const std::uint8_t *image;
    const float *table;
    std::ptrdiff_t height, width, window, margin;
    std::vector<float> rows;  // logarithms, all of them
    std::vector<double> columns, work, spare, sums;

    Details(const std::uint8_t *pixels, const float *logs, std::ptrdiff_t rows_px, std::ptrdiff_t columns_px,
            std::ptrdiff_t window_px)
        : image(pixels), table(logs), height(rows_px), width(columns_px), window(window_px), margin(window_px / 2),
          rows(static_cast<std::size_t>(rows_px * columns_px)), columns(columns_px + 2 * margin, 0.0),
          work(columns.size()), spare(columns.size()), sums(columns_px) {
        for (std::ptrdiff_t at = 0; at < height * width; ++at) rows[at] = table[image[at]];
        for (std::ptrdiff_t y = -margin; y < margin; ++y) add_row(row(y), nullptr, middle(), width);
    }
    const float *row(std::ptrdiff_t y) const {
        return rows.data() + mirrored(static_cast<int>(y), static_cast<int>(height)) * width;
    }
    double *middle() { return columns.data() + margin; }
    void take(std::ptrdiff_t y, float *to) {  // one after another from 0
        add_row(row(y + margin), y > 0 ? row(y - margin - 1) : nullptr, middle(), width);
        for (std::ptrdiff_t x = 1; x <= margin; ++x) {
            middle()[-x] = middle()[mirrored(static_cast<int>(-x), static_cast<int>(width))];
            middle()[width - 1 + x] = middle()[mirrored(static_cast<int>(width - 1 + x), static_cast<int>(width))];
        }
        detail_row(row(y), columns.data(), static_cast<int>(window), 1.0 / static_cast<double>(window * window),
                   work.data(), spare.data(), sums.data(), to, width);
    }
};

Floats32 detail_products(const Bytes &before, const Bytes &after, const Floats32 &table, int window, int cell) {
    const std::ptrdiff_t height = before.shape(0), width = before.shape(1), high = height / cell, wide = width / cell;
    Floats32 means({pybind11::ssize_t(3), static_cast<pybind11::ssize_t>(high), static_cast<pybind11::ssize_t>(wide)});
    const std::uint8_t *one = before.data(), *other = after.data();
    const float *logs = table.data();
    float *to = means.mutable_data();
    pybind11::gil_scoped_release released;
    Details first(one, logs, height, width, window), second(other, logs, height, width, window);
    std::vector<float> work(5 * static_cast<std::size_t>(width));
    float *a = work.data(), *b = a + width, *sums = b + width;
    const float share = 1.0f / static_cast<float>(cell * cell);
    for (std::ptrdiff_t y = 0; y < high * cell; ++y) {
        first.take(y, a), second.take(y, b);
        if (y % cell == 0) std::fill(sums, sums + 3 * width, 0.0f);
        add_products(a, b, sums, sums + width, sums + 2 * width, width);
        if (y % cell < cell - 1) continue;
        for (std::ptrdiff_t plane = 0; plane < 3; ++plane) {
            const float *from = sums + plane * width;
            float *row = to + (plane * high + y / cell) * wide;
            for (std::ptrdiff_t x = 0; x < wide; ++x, from += cell) {
                float sum = from[0];
                for (std::ptrdiff_t by = 1; by < cell; ++by) sum += from[by];
                row[x] = sum * share;
            }
        }
    }
    return means;
}

SORVOLO_CLONES
void add_weighted(const float *row, float weight, double *sums, std::ptrdiff_t count) {
    for (std::ptrdiff_t x = 0; x < count; ++x) sums[x] += weight * row[x];
}

SORVOLO_CLONES
void lengths_of(const std::uint8_t *row, float *to, std::ptrdiff_t count) {
    for (std::ptrdiff_t x = 0; x < count; ++x) to[x] = std::abs(static_cast<float>(row[x]) - 128.0f);
}

// Calls add(place, share) for each of the pixels that the cell covers, a part of the first and of the last of them.
template <typename Add>
void covered(std::ptrdiff_t cell, std::ptrdiff_t cells, std::ptrdiff_t size, Add add) {
    const double scale = static_cast<double>(size) / static_cast<double>(cells);
    const double from = scale * static_cast<double>(cell), to = std::min(from + scale, static_cast<double>(size));
    for (std::ptrdiff_t at = static_cast<std::ptrdiff_t>(from); at < size && static_cast<double>(at) < to; ++at) {
        const double start = std::max(from, static_cast<double>(at));
        const double share = std::min(to, static_cast<double>(at + 1)) - start;
        if (share > 1e-9) add(at, static_cast<float>(share / scale));
    }
}

Floats32 flow_on_grid(const Floats32 &flow, const Bytes &details, int rows, int columns) {
    const std::ptrdiff_t height = details.shape(0), width = details.shape(1);
    Floats32 grid({pybind11::ssize_t(rows), pybind11::ssize_t(columns), pybind11::ssize_t(3)});
    const float *moves = flow.data();
    const std::uint8_t *detail = details.data();
    float *to = grid.mutable_data();
    pybind11::gil_scoped_release released;
    std::vector<double> sums(3 * static_cast<std::size_t>(width));
    std::vector<float> lengths(width);
    for (std::ptrdiff_t row = 0; row < rows; ++row) {
        std::fill(sums.begin(), sums.end(), 0.0);
        covered(row, rows, height, [&](std::ptrdiff_t y, float share) {
            add_weighted(moves + 2 * y * width, share, sums.data(), 2 * width);
            lengths_of(detail + y * width, lengths.data(), width);
            add_weighted(lengths.data(), share, sums.data() + 2 * width, width);
        });
        for (std::ptrdiff_t column = 0; column < columns; ++column, to += 3) {
            double x_move = 0, y_move = 0, length = 0;
            covered(column, columns, width, [&](std::ptrdiff_t x, float share) {
                x_move += share * sums[2 * x], y_move += share * sums[2 * x + 1], length += share * sums[2 * width + x];
            });
            to[0] = static_cast<float>(x_move), to[1] = static_cast<float>(y_move), to[2] = static_cast<float>(length);
        }
    }
    return grid;
}

}  // namespace

void bind_light(pybind11::module_ &module) {
    using pybind11::arg;
    module.def("slopes", &slopes, arg("before").noconvert(), arg("after").noconvert(), arg("prior"));
    module.def("fit_moves", &fit_moves, arg("rows_x").noconvert(), arg("rows_y").noconvert(), arg("moves").noconvert(),
               arg("trust").noconvert(), arg("ridge").noconvert(), arg("wide"), arg("high"));
    module.def("detail_products", &detail_products, arg("before").noconvert(), arg("after").noconvert(),
               arg("table").noconvert(), arg("window"), arg("cell"));
    module.def("flow_on_grid", &flow_on_grid, arg("flow").noconvert(), arg("details").noconvert(), arg("rows"),
               arg("columns"));
}

}  // namespace sorvolo
