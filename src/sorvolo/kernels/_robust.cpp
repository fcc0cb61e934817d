// Kernels of the robust change method.
//
// To add one: write it here in namespace sorvolo, SORVOLO_CLONES before the function with the hot loop, and bind it
// below with a pybind11::gil_scoped_release around that loop; declare it in _native.pyi, write the same in
// NumPy in reference_robust.py, let __init__.py hand it on, test that both agree. Then `pip install --no-deps -e .`.
#include "_native.hpp"

#include <pybind11/stl.h>

#include <cmath>
#include <cstddef>
#include <cstdlib>

// Compiled twice, the better one chosen when the module is loaded.
#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__)
#define ROBUST_CLONES __attribute__((target_clones("avx2", "default")))
#else
#define ROBUST_CLONES
#endif

namespace sorvolo {

namespace {

using Integers32 = pybind11::array_t<std::int32_t, pybind11::array::c_style>;
using Words = pybind11::array_t<std::uint16_t, pybind11::array::c_style>;
using Doubles = pybind11::array_t<double, pybind11::array::c_style>;

ROBUST_CLONES
void relight_pixels(const std::uint8_t *from, const std::int32_t *curves, const std::uint16_t *gains, std::uint8_t *to,
                    std::int64_t pixels) {
    for (std::int64_t at = 0; at < pixels * 3; at += 3) {
        for (int channel = 0; channel < 3; ++channel) {
            const std::int32_t product = curves[channel * 256 + from[at + channel]] * gains[at + channel];
            to[at + channel] = static_cast<std::uint8_t>(std::clamp(((product + (1 << 15)) >> 16) - 8, 0, 255));
        }
    }
}

void relight(const Bytes &image, const Integers32 &curves, const Words &gains, Bytes &lit) {
    const std::uint8_t *from = image.data();
    const std::int32_t *curve = curves.data();
    const std::uint16_t *gain = gains.data();
    std::uint8_t *to = lit.mutable_data();
    const std::int64_t pixels = image.shape(0) * image.shape(1);
    pybind11::gil_scoped_release released;
    relight_pixels(from, curve, gain, to, pixels);
}

// How much redder than blue the query is against the reference, in quarter steps of `logs`, rounded to even, 128 alike.
void tint(const Bytes &reference, const Bytes &query, const Bytes &logs, const Integers32 &boxes, int margin,
          Bytes &out) {
    const int height = static_cast<int>(out.shape(0)), width = static_cast<int>(out.shape(1));
    const std::uint8_t *before = reference.data(), *after = query.data(), *log = logs.data();
    const std::int32_t *box = boxes.data();
    std::uint8_t *to = out.mutable_data();
    pybind11::gil_scoped_release released;
    std::int32_t quarter[511];
    for (int step = -255; step <= 255; ++step)
        quarter[step + 255] = static_cast<std::int32_t>(std::nearbyint(64.0 + step / 4.0));
    for (pybind11::ssize_t region = 0; region < boxes.shape(0); ++region, box += 4) {
        const int left = std::max(box[0] - margin, 0), right = std::min(box[0] + box[2] + margin, width);
        const int top = std::max(box[1] - margin, 0), bottom = std::min(box[1] + box[3] + margin, height);
        for (int y = top; y < bottom; ++y) {
            for (std::int64_t at = static_cast<std::int64_t>(y) * width + left,
                              end = static_cast<std::int64_t>(y) * width + right;
                 at < end; ++at) {
                const std::uint8_t *a = before + 3 * at, *b = after + 3 * at;
                to[at] = static_cast<std::uint8_t>(std::min(
                    quarter[log[b[2]] - log[a[2]] + 255] + quarter[log[a[0]] - log[b[0]] + 255], 255));
            }
        }
    }
}

// Along each region's rim, two pixels wide: the sum of `came` less that of `went`.
Integers64 rim_balance(const Integers32 &labels, const Integers32 &boxes, const Bytes &came, const Bytes &went) {
    const int height = static_cast<int>(labels.shape(0)), width = static_cast<int>(labels.shape(1));
    Integers64 balance({boxes.shape(0)});
    const std::int32_t *label = labels.data(), *box = boxes.data();
    const std::uint8_t *plus = came.data(), *minus = went.data();
    std::int64_t *to = balance.mutable_data();
    pybind11::gil_scoped_release released;
    for (pybind11::ssize_t region = 0; region < boxes.shape(0); ++region, box += 4) {
        std::int64_t sum = 0;
        for (int y = box[1]; y < box[1] + box[3]; ++y) {
            for (int x = box[0]; x < box[0] + box[2]; ++x) {
                const std::int64_t at = static_cast<std::int64_t>(y) * width + x;
                if (label[at] != region + 1) continue;
                const int first = std::max(x - 2, 0), last = std::min(x + 2, width - 1);
                bool is_rim = false;
                for (int ny = std::max(y - 2, 0); ny <= std::min(y + 2, height - 1) && !is_rim; ++ny) {
                    const std::int32_t *row = label + static_cast<std::int64_t>(ny) * width;
                    is_rim = row[first] == 0 || row[last] == 0 || row[x] == 0 || row[std::min(first + 1, last)] == 0 ||
                             row[std::max(last - 1, first)] == 0;
                }
                if (is_rim) sum += static_cast<std::int64_t>(plus[at]) - minus[at];
            }
        }
        to[region] = sum;
    }
    return balance;
}

void looked_up(const Integers32 &labels, const Bytes &table, Bytes &out) {
    const std::int64_t pixels = labels.shape(0) * labels.shape(1);
    const std::int32_t *label = labels.data();
    const std::uint8_t *value = table.data();
    std::uint8_t *to = out.mutable_data();
    pybind11::gil_scoped_release released;
    for (std::int64_t at = 0; at < pixels; ++at) to[at] = value[label[at]];
}

// Which values lie over their thresholds, 1 or 0.
ROBUST_CLONES
void mark_over(const std::uint8_t *value, const std::uint8_t *threshold, std::uint8_t *to, std::int64_t pixels) {
    for (std::int64_t at = 0; at < pixels; ++at) to[at] = value[at] > threshold[at];
}

// Hands each 8-connected part of `left`, whose pixels are 1 or 0, to `take`, in order of first pixels; clears it.
template <typename Take>
void collect_parts(int width, int height, std::vector<std::uint8_t> &left, Take take) {
    std::vector<std::int32_t> part;
    const std::int32_t pixels = width * height;
    for (std::int32_t start = 0; start < pixels; ++start) {
        std::uint64_t eight;
        for (; start + 8 <= pixels; start += 8) {
            std::memcpy(&eight, left.data() + start, 8);
            if (eight) break;
        }
        while (start < pixels && !left[start]) ++start;
        if (start == pixels) break;
        part.assign(1, start);
        left[start] = 0;
        for (std::size_t next = 0; next < part.size(); ++next) {
            const int x = part[next] % width, y = part[next] / width;
            for (int ny = std::max(y - 1, 0); ny <= std::min(y + 1, height - 1); ++ny) {
                for (int nx = std::max(x - 1, 0); nx <= std::min(x + 1, width - 1); ++nx) {
                    const std::int32_t near = ny * width + nx;
                    if (!left[near]) continue;
                    left[near] = 0;
                    part.push_back(near);
                }
            }
        }
        take(part);
    }
}

struct Core {
    std::int64_t total;
    std::vector<std::int32_t> pixels;
};

pybind11::tuple core_regions(const Bytes &values, const Bytes &thresholds, double strong, double core, int least_area,
                             int most) {
    const int height = static_cast<int>(values.shape(0)), width = static_cast<int>(values.shape(1));
    const std::uint8_t *value = values.data(), *threshold = thresholds.data();
    Integers32 labels({values.shape(0), values.shape(1)});
    std::int32_t *label = labels.mutable_data();
    std::vector<Core> cores;
    {
        pybind11::gil_scoped_release released;
        const std::int64_t pixels = static_cast<std::int64_t>(width) * height;
        std::fill(label, label + pixels, 0);
        std::vector<std::uint8_t> weak(pixels), inside(pixels, 0);
        mark_over(value, threshold, weak.data(), pixels);
        collect_parts(width, height, weak, [&](const std::vector<std::int32_t> &part) {
            std::int64_t total = 0, squares = 0;
            int strong_ones = 0;
            for (const std::int32_t at : part) {
                total += value[at], squares += static_cast<std::int64_t>(value[at]) * value[at];
                strong_ones += static_cast<double>(value[at]) > strong * threshold[at];
            }
            if (strong_ones < 2) return;
            const double least = core * static_cast<double>(squares) / static_cast<double>(total);
            for (const std::int32_t at : part)
                if (static_cast<double>(value[at]) > least) inside[at] = 1;
        });
        collect_parts(width, height, inside, [&](const std::vector<std::int32_t> &part) {
            if (static_cast<int>(part.size()) < least_area) return;
            std::int64_t total = 0;
            for (const std::int32_t at : part) total += value[at];
            cores.push_back({total, part});
        });
        std::stable_sort(cores.begin(), cores.end(), [](const Core &a, const Core &b) { return a.total > b.total; });
        if (static_cast<int>(cores.size()) > most) cores.resize(most);
        for (std::size_t each = 0; each < cores.size(); ++each)
            for (const std::int32_t at : cores[each].pixels) label[at] = static_cast<std::int32_t>(each) + 1;
    }
    Integers32 boxes({static_cast<pybind11::ssize_t>(cores.size()), pybind11::ssize_t(4)});
    std::int32_t *box = boxes.mutable_data();
    for (const Core &each : cores) {
        int left = width, right = 0, top = height, bottom = 0;
        for (const std::int32_t at : each.pixels) {
            left = std::min(left, at % width), right = std::max(right, at % width);
            top = std::min(top, at / width), bottom = std::max(bottom, at / width);
        }
        box[0] = left, box[1] = top, box[2] = right - left + 1, box[3] = bottom - top + 1;
        box += 4;
    }
    return pybind11::make_tuple(labels, boxes);
}

Integers64 measure_regions(const Integers32 &labels, const Integers32 &boxes, const std::vector<Bytes> &channels,
                           int margin) {
    const int height = static_cast<int>(labels.shape(0)), width = static_cast<int>(labels.shape(1));
    const int count = static_cast<int>(channels.size()), fields = 2 * count + 1;
    const pybind11::ssize_t regions = boxes.shape(0);
    Integers64 sums({regions, pybind11::ssize_t(2), pybind11::ssize_t(fields)});
    const std::int32_t *label = labels.data(), *box = boxes.data();
    std::vector<const std::uint8_t *> values;
    for (const Bytes &each : channels) values.push_back(each.data());
    std::int64_t *to = sums.mutable_data();
    pybind11::gil_scoped_release released;
    std::fill(to, to + regions * 2 * fields, 0);
    for (pybind11::ssize_t region = 0; region < regions; ++region, box += 4, to += 2 * fields) {
        const int left = std::max(box[0] - margin, 0), right = std::min(box[0] + box[2] + margin, width);
        const int top = std::max(box[1] - margin, 0), bottom = std::min(box[1] + box[3] + margin, height);
        for (int y = top; y < bottom; ++y) {
            for (int x = left; x < right; ++x) {
                const std::int64_t at = static_cast<std::int64_t>(y) * width + x;
                const std::int32_t here = label[at];
                if (here != 0 && here != region + 1) continue;
                std::int64_t *row = here == 0 ? to + fields : to;
                ++row[0];
                for (int channel = 0; channel < count; ++channel) {
                    const std::int32_t value = values[channel][at];
                    row[1 + channel] += value;
                    row[1 + count + channel] += value * value;
                }
            }
        }
    }
    return sums;
}

struct Sums {
    std::int64_t n = 0, q = 0, qq = 0, t = 0, tt = 0, qt = 0, apart = 0;
};

// How alike two windows are, from their sums: -1 to 1, and 0 where one of them is flat.
double correlation(const Sums &s) {
    const std::int64_t spread_q = s.n * s.qq - s.q * s.q, spread_t = s.n * s.tt - s.t * s.t;
    if (spread_q <= 0 || spread_t <= 0) return 0.0;
    return static_cast<double>(s.n * s.qt - s.q * s.t) /
           (std::sqrt(static_cast<double>(spread_q)) * std::sqrt(static_cast<double>(spread_t)));
}

// The sums of a window that the shift changes; both windows lie in steps of one, `query` without gaps between its rows.
ROBUST_CLONES
void sum_window(const std::uint8_t *query, const std::int16_t *query_words, const std::uint8_t *reference,
                const std::int16_t *reference_words, std::int64_t reference_row, int wide, int high, Sums *total) {
    for (int y = 0; y < high; ++y) {
        const std::int64_t row = static_cast<std::int64_t>(y) * wide;
        const std::uint8_t *a = query + row, *b = reference + y * reference_row;
        const std::int16_t *u = query_words + row, *v = reference_words + y * reference_row;
        std::int32_t qt = 0, t = 0, tt = 0, apart = 0;
        for (std::ptrdiff_t x = 0; x < wide; ++x) {
            qt += u[x] * v[x], tt += v[x] * v[x], t += b[x];
            apart += std::abs(static_cast<int>(a[x]) - static_cast<int>(b[x]));
        }
        total->t += t, total->tt += tt, total->qt += qt, total->apart += apart;
    }
}

constexpr int MOST_AT_ONCE_PX = 64;
constexpr int LANES = 16;  // shifts along x that are summed at once

// As above for the shifts 0 .. LANES - 1 along x: narrow windows leave a processor's lanes empty, shifts do not.
ROBUST_CLONES
void sum_shifts(const std::uint8_t *query, const std::uint8_t *reference, std::int64_t reference_row, int wide,
                int high, Sums *totals) {
    std::int32_t qt[LANES] = {}, tt[LANES] = {}, t[LANES] = {}, apart[LANES] = {};
    for (int y = 0; y < high; ++y) {
        const std::uint8_t *a = query + static_cast<std::int64_t>(y) * wide, *b = reference + y * reference_row;
        std::uint16_t row_t[LANES] = {}, row_apart[LANES] = {};
        for (std::ptrdiff_t x = 0; x < wide; ++x) {
            const std::int16_t u = a[x];
            for (int lane = 0; lane < LANES; ++lane) {
                const std::int16_t v = b[x + lane];
                const std::int16_t step = static_cast<std::int16_t>(u - v);
                const std::uint16_t square = static_cast<std::uint16_t>(v * v);
                const std::uint16_t product = static_cast<std::uint16_t>(u * v);
                row_t[lane] = static_cast<std::uint16_t>(row_t[lane] + v);
                row_apart[lane] = static_cast<std::uint16_t>(row_apart[lane] + std::max<std::int16_t>(step, -step));
                qt[lane] += product, tt[lane] += square;
            }
        }
        for (int lane = 0; lane < LANES; ++lane) t[lane] += row_t[lane], apart[lane] += row_apart[lane];
    }
    for (int lane = 0; lane < LANES; ++lane) {
        totals[lane].t = t[lane], totals[lane].tt = tt[lane];
        totals[lane].qt = qt[lane], totals[lane].apart = apart[lane];
    }
}

Doubles match_regions(const Bytes &query, const Bytes &reference, const Integers32 &boxes, int reach) {
    const std::int64_t width = query.shape(1), padded = reference.shape(1);
    const pybind11::ssize_t regions = boxes.shape(0);
    Doubles found({regions, pybind11::ssize_t(6)});
    const std::int32_t *box = boxes.data();
    double *to = found.mutable_data();
    const std::uint8_t *q0 = query.data(), *t0 = reference.data();
    pybind11::gil_scoped_release released;
    std::vector<std::uint8_t> asked, searched;
    std::vector<std::int16_t> asked_words, searched_words;
    std::vector<Sums> lanes;
    for (pybind11::ssize_t region = 0; region < regions; ++region, box += 4, to += 6) {
        const int step = std::max(1, std::max(box[2], box[3]) / 32);
        const int wide = (box[2] + step - 1) / step, high = (box[3] + step - 1) / step;
        Sums in_query;
        asked.clear();
        for (int y = 0; y < box[3]; y += step) {
            for (int x = 0; x < box[2]; x += step) {
                const std::int64_t value = q0[(box[1] + y) * width + box[0] + x];
                asked.push_back(static_cast<std::uint8_t>(value));
                in_query.q += value, in_query.qq += value * value;
            }
        }
        in_query.n = static_cast<std::int64_t>(wide) * high;
        asked_words.assign(asked.begin(), asked.end());
        // every step-th row and column belong together: the searched window falls into step x step pictures
        const int across = wide + (2 * reach) / step + 1, down = high + (2 * reach) / step + 1;
        const std::size_t phase_size = static_cast<std::size_t>(across) * down;
        searched.assign(phase_size * step * step + LANES, 0);  // lanes may look past the last row
        const int rows = box[3] + 2 * reach, columns = box[2] + 2 * reach;
        for (int y = 0; y < rows; ++y) {
            const std::uint8_t *line = t0 + (box[1] + y) * padded + box[0];
            if (y / step >= down) break;
            for (int x = 0; x < columns && x / step < across; ++x)
                searched[((y % step) * step + x % step) * phase_size + (y / step) * across + x / step] = line[x];
        }
        const bool at_once = step == 1 && wide < MOST_AT_ONCE_PX;
        searched_words.assign(searched.begin(), searched.end());
        double best = -2.0, least = 256.0;
        for (int dy = 0; dy <= 2 * reach; ++dy) {
            for (int dx = 0; dx <= 2 * reach; ++dx) {
                Sums sums = in_query;
                if (at_once && dx % LANES == 0) {
                    lanes.assign(LANES, in_query);
                    sum_shifts(asked.data(), searched.data() + static_cast<std::size_t>(dy) * across + dx, across, wide,
                               high, lanes.data());
                }
                if (at_once) sums = lanes[dx % LANES];
                const std::size_t at = ((dy % step) * step + dx % step) * phase_size + (dy / step) * across + dx / step;
                if (!at_once)
                    sum_window(asked.data(), asked_words.data(), searched.data() + at,
                               searched_words.data() + at, across, wide, high, &sums);
                const double alike = correlation(sums);
                const double apart = static_cast<double>(sums.apart) / static_cast<double>(sums.n);
                if (dx == reach && dy == reach) to[0] = alike, to[4] = apart;
                if (alike > best) best = alike, to[2] = dx - reach, to[3] = dy - reach;
                least = std::min(least, apart);
            }
        }
        to[1] = best, to[5] = least;
    }
    return found;
}

}  // namespace

void bind_robust(pybind11::module_ &module) {
    using pybind11::arg;
    module.def("relight", &relight, arg("image").noconvert(), arg("curves").noconvert(), arg("gains").noconvert(),
               arg("out").noconvert());
    module.def("looked_up", &looked_up, arg("labels").noconvert(), arg("table").noconvert(), arg("out").noconvert());
    module.def("tint", &tint, arg("reference").noconvert(), arg("query").noconvert(), arg("logs").noconvert(),
               arg("boxes").noconvert(), arg("margin"), arg("out").noconvert());
    module.def("rim_balance", &rim_balance, arg("labels").noconvert(), arg("boxes").noconvert(),
               arg("came").noconvert(), arg("went").noconvert());
    module.def("core_regions", &core_regions, arg("values").noconvert(), arg("thresholds").noconvert(), arg("strong"),
               arg("core"), arg("least_area"), arg("most"));
    module.def("measure_regions", &measure_regions, arg("labels").noconvert(), arg("boxes").noconvert(),
               arg("channels"), arg("margin"));
    module.def("match_regions", &match_regions, arg("query").noconvert(), arg("reference").noconvert(),
               arg("boxes").noconvert(), arg("reach"));
}

}  // namespace sorvolo
