// Kernels of the robust change method.
//
// To add one: write it here in namespace sorvolo, SORVOLO_CLONES before the function with the hot loop, and bind it
// below with a pybind11::gil_scoped_release around that loop; declare it in _native.pyi, write the same in
// NumPy in tests/kernels/numpy_robust.py, let __init__.py hand it on, test that both agree. Then `pip install --no-deps -e .`.
#include "_native.hpp"

#include <pybind11/stl.h>

#include <cmath>
#include <cstddef>
#include <cstdlib>

namespace sorvolo {

namespace {

using Integers32 = pybind11::array_t<std::int32_t, pybind11::array::c_style>;
using Doubles = pybind11::array_t<double, pybind11::array::c_style>;

constexpr std::ptrdiff_t RUN = 3 * 512;
constexpr float TO_WHOLE = 12582912.0f;  // 1.5 * 2**23: added and taken off again, it rounds to the nearest even

// A run at a time: tables are read value by value, the rest is done for many values at once. Gains lie between two rows.
SORVOLO_CLONES
void relight_values(const std::uint8_t *from, const std::uint16_t *curves, const float *above, const float *below,
                    float share, std::uint8_t *to, std::ptrdiff_t values) {
    std::uint16_t lifted[RUN];
    const float rest = 1.0f - share;
    for (; values > 0; values -= RUN, from += RUN, above += RUN, below += RUN, to += RUN) {
        const std::ptrdiff_t count = std::min(values, RUN);
        for (std::ptrdiff_t at = 0; at < count; at += 3)
            for (int channel = 0; channel < 3; ++channel)
                lifted[at + channel] = curves[channel * 256 + from[at + channel]];
        SORVOLO_INDEPENDENT
        for (std::ptrdiff_t at = 0; at < count; ++at) {
            const float gain = (above[at] * rest + below[at] * share + TO_WHOLE) - TO_WHOLE;
            const std::int32_t product = static_cast<std::int32_t>(lifted[at]) * static_cast<std::int32_t>(gain);
            to[at] = static_cast<std::uint8_t>(std::clamp(((product + (1 << 15)) >> 16) - 8, 0, 255));
        }
    }
}

void relight(const Bytes &image, const Integers32 &curves, const Floats32 &gains, std::ptrdiff_t left,
             std::ptrdiff_t top, std::ptrdiff_t wide, std::ptrdiff_t high, Bytes &lit) {
    const std::ptrdiff_t height = image.shape(0), width = image.shape(1), lines = gains.shape(0);
    const std::uint8_t *from = image.data();
    const float *gain = gains.data();
    std::uint8_t *to = lit.mutable_data();
    std::uint16_t curve[3 * 256];
    std::copy(curves.data(), curves.data() + 3 * 256, curve);
    pybind11::gil_scoped_release released;
    const double scale = static_cast<double>(lines) / static_cast<double>(height);
    for (std::ptrdiff_t y = top; y < top + high; ++y) {
        const float place = static_cast<float>((static_cast<double>(y) + 0.5) * scale - 0.5);
        const float line = std::floor(place);
        const std::ptrdiff_t above = static_cast<std::ptrdiff_t>(line);
        const auto row = [&](std::ptrdiff_t number) {
            return gain + 3 * (std::clamp<std::ptrdiff_t>(number, 0, lines - 1) * width + left);
        };
        const std::ptrdiff_t at = 3 * (y * width + left);
        relight_values(from + at, curve, row(above), row(above + 1), place - line, to + at, 3 * wide);
    }
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

// Along a region's rim, two pixels wide: the sum of `came` less that of `went`. `box` is the region's.
SORVOLO_CLONES
std::int64_t balance_of(const std::uint8_t *label, const std::uint8_t *came, const std::uint8_t *went,
                        std::ptrdiff_t width, std::ptrdiff_t height, const std::int32_t *box, std::uint8_t number,
                        std::vector<std::uint8_t> &work) {
    const std::ptrdiff_t left = box[0], top = box[1], wide = box[2], bottom = top + box[3];
    const std::ptrdiff_t first = std::max<std::ptrdiff_t>(top - 2, 0), last = std::min(bottom + 2, height);
    work.assign(static_cast<std::size_t>((last - first + 2) * wide + 4), 0);
    std::uint8_t *near = work.data(), *none = near + (last - first) * wide, *rim = none + wide + 4;
    const std::ptrdiff_t from = std::max<std::ptrdiff_t>(left - 2, 0), to = std::min(left + wide + 2, width);
    for (std::ptrdiff_t y = first; y < last; ++y) {
        const std::uint8_t *row = label + y * width;
        std::uint8_t *here = none - (left - 2);
        SORVOLO_INDEPENDENT
        for (std::ptrdiff_t x = from; x < to; ++x) here[x] = row[x] == 0;
        std::uint8_t *line = near + (y - first) * wide;
        SORVOLO_INDEPENDENT
        for (std::ptrdiff_t x = 0; x < wide; ++x)
            line[x] = none[x] | none[x + 1] | none[x + 2] | none[x + 3] | none[x + 4];
    }
    std::int64_t sum = 0;
    for (std::ptrdiff_t y = top; y < bottom; ++y) {
        std::memset(rim, 0, wide);
        for (std::ptrdiff_t beside = std::max(y - 2, first); beside < std::min(y + 3, last); ++beside) {
            const std::uint8_t *line = near + (beside - first) * wide;
            SORVOLO_INDEPENDENT
            for (std::ptrdiff_t x = 0; x < wide; ++x) rim[x] |= line[x];
        }
        const std::ptrdiff_t at = y * width + left;
        std::int32_t along = 0;
        for (std::ptrdiff_t x = 0; x < wide; ++x) {
            const std::int32_t more = came[at + x] - went[at + x];
            along += label[at + x] == number && rim[x] ? more : 0;
        }
        sum += along;
    }
    return sum;
}

Integers64 rim_balance(const Bytes &labels, const Integers32 &boxes, const Bytes &came, const Bytes &went) {
    const std::ptrdiff_t height = labels.shape(0), width = labels.shape(1);
    Integers64 balance({boxes.shape(0)});
    const std::int32_t *box = boxes.data();
    const std::uint8_t *label = labels.data(), *plus = came.data(), *minus = went.data();
    std::int64_t *to = balance.mutable_data();
    pybind11::gil_scoped_release released;
    std::vector<std::uint8_t> work;
    for (pybind11::ssize_t region = 0; region < boxes.shape(0); ++region, box += 4)
        to[region] = balance_of(label, plus, minus, width, height, box, static_cast<std::uint8_t>(region + 1), work);
    return balance;
}

// Which values lie over their thresholds, 1 or 0.
SORVOLO_CLONES
void mark_over(const std::uint8_t *value, const std::uint8_t *threshold, std::uint8_t *to, std::ptrdiff_t pixels) {
    SORVOLO_INDEPENDENT
    for (std::ptrdiff_t at = 0; at < pixels; ++at) to[at] = value[at] > threshold[at];
}

constexpr std::size_t MOST_KEPT = std::size_t{1} << 21;  // bytes of one working array

// Pixels with an even margin of one all around: rows are `stride` long, the margin at the end of one is that at the
// start of the next.
struct Margined {
    std::ptrdiff_t stride = 0;
    std::vector<std::uint8_t> pixels;

    void begin(std::ptrdiff_t columns, std::ptrdiff_t rows) {
        stride = columns + 1;
        pixels.assign(static_cast<std::size_t>((rows + 2) * stride + 1), 0);
    }
    std::uint8_t *row(std::ptrdiff_t y) { return pixels.data() + (y + 1) * stride + 1; }
    void take(const std::uint8_t *from, std::ptrdiff_t columns, std::ptrdiff_t rows) {  // the margin holds anything
        stride = columns + 1;
        pixels.resize(static_cast<std::size_t>((rows + 2) * stride + 1));
        for (std::ptrdiff_t y = 0; y < rows; ++y) std::memcpy(row(y), from + y * columns, columns);
    }
    void end() {  // what is large is given back
        if (pixels.size() > MOST_KEPT) std::vector<std::uint8_t>().swap(pixels);
    }
};

// Hands each 8-connected part of `left`, whose pixels are 1 or 0, to `take`, in order of first pixels; clears it.
// Pixels are identified by where they lie in `left.pixels`.
template <typename Take>
void collect_parts(Margined &left, Take take) {
    const std::ptrdiff_t size = static_cast<std::ptrdiff_t>(left.pixels.size()), stride = left.stride;
    const std::ptrdiff_t around[8] = {-stride - 1, -stride, -stride + 1, -1, 1, stride - 1, stride, stride + 1};
    std::uint8_t *is_left = left.pixels.data();
    std::vector<std::int32_t> part;
    for (std::ptrdiff_t start = 0; start < size; ++start) {
        std::uint64_t eight;
        for (; start + 8 <= size; start += 8) {
            std::memcpy(&eight, is_left + start, 8);
            if (eight) break;
        }
        while (start < size && !is_left[start]) ++start;
        if (start == size) break;
        part.assign(1, static_cast<std::int32_t>(start));
        is_left[start] = 0;
        for (std::size_t next = 0; next < part.size(); ++next) {
            const std::ptrdiff_t here = part[next];
            for (const std::ptrdiff_t step : around) {
                if (!is_left[here + step]) continue;
                is_left[here + step] = 0;
                part.push_back(static_cast<std::int32_t>(here + step));
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
    const std::ptrdiff_t height = values.shape(0), width = values.shape(1);
    const std::uint8_t *value_rows = values.data(), *threshold_rows = thresholds.data();
    Bytes labels({values.shape(0), values.shape(1)});
    std::uint8_t *label = labels.mutable_data();
    std::vector<std::int32_t> found;
    {
        pybind11::gil_scoped_release released;
        std::memset(label, 0, width * height);
        // kept from call to call: asking the system for memory costs more than the search
        thread_local Margined weak, inside, held, limits;
        weak.begin(width, height), inside.begin(width, height);
        held.take(value_rows, width, height), limits.take(threshold_rows, width, height);
        for (std::ptrdiff_t y = 0; y < height; ++y)
            mark_over(value_rows + y * width, threshold_rows + y * width, weak.row(y), width);
        const std::uint8_t *value = held.pixels.data(), *threshold = limits.pixels.data();
        collect_parts(weak, [&](const std::vector<std::int32_t> &part) {
            std::int64_t total = 0, squares = 0;
            int strong_ones = 0;
            for (const std::int32_t at : part) {
                total += value[at], squares += static_cast<std::int64_t>(value[at]) * value[at];
                strong_ones += static_cast<double>(value[at]) > strong * threshold[at];
            }
            if (strong_ones < 2) return;
            const double least = core * static_cast<double>(squares) / static_cast<double>(total);
            for (const std::int32_t at : part)
                if (static_cast<double>(value[at]) > least) inside.pixels[at] = 1;
        });
        std::vector<Core> cores;
        collect_parts(inside, [&](const std::vector<std::int32_t> &part) {
            if (static_cast<int>(part.size()) < least_area) return;
            std::int64_t total = 0;
            for (const std::int32_t at : part) total += value[at];
            cores.push_back({total, part});
        });
        std::stable_sort(cores.begin(), cores.end(), [](const Core &a, const Core &b) { return a.total > b.total; });
        if (static_cast<int>(cores.size()) > most) cores.resize(most);
        for (std::size_t each = 0; each < cores.size(); ++each) {
            std::ptrdiff_t left = width, right = 0, top = height, bottom = 0;
            for (const std::int32_t at : cores[each].pixels) {
                const std::ptrdiff_t y = at / weak.stride - 1, x = at % weak.stride - 1;
                label[y * width + x] = static_cast<std::uint8_t>(each + 1);
                left = std::min(left, x), right = std::max(right, x);
                top = std::min(top, y), bottom = std::max(bottom, y);
            }
            for (const std::ptrdiff_t side : {left, top, right - left + 1, bottom - top + 1})
                found.push_back(static_cast<std::int32_t>(side));
        }
        weak.end(), inside.end(), held.end(), limits.end();
    }
    Integers32 boxes({static_cast<pybind11::ssize_t>(found.size() / 4), pybind11::ssize_t(4)});
    std::copy(found.begin(), found.end(), boxes.mutable_data());
    return pybind11::make_tuple(labels, boxes);
}

// Adds up one region's window, columns left .. right - 1: `to` are count, sums and sums of squares of each of the
// `channels`, for the region and then for what is of no region. `masks` holds twice the picture's width.
SORVOLO_CLONES
void measure_region(const std::uint8_t *label, const std::uint8_t *const *channels, std::ptrdiff_t count,
                    std::ptrdiff_t width, std::ptrdiff_t left, std::ptrdiff_t right, std::ptrdiff_t top,
                    std::ptrdiff_t bottom, std::uint8_t number, std::uint8_t *masks, std::int64_t *to) {
    // whole sixteens of columns, those beside the window masked: nothing is left over to be summed one by one
    const std::ptrdiff_t wide = std::min((right - left + 15) / 16 * 16, width), begin = std::min(left, width - wide);
    std::uint8_t *mine = masks, *around = masks + wide;
    std::memset(masks, 0, 2 * wide);
    std::int64_t *to_around = to + 2 * count + 1;
    for (std::ptrdiff_t y = top; y < bottom; ++y) {
        const std::uint8_t *row = label + y * width + begin;
        std::int32_t mine_count = 0, around_count = 0;
        SORVOLO_INDEPENDENT
        for (std::ptrdiff_t x = left - begin; x < right - begin; ++x) {
            mine[x] = row[x] == number ? 255 : 0, around[x] = row[x] == 0 ? 255 : 0;
            mine_count += row[x] == number, around_count += row[x] == 0;
        }
        to[0] += mine_count, to_around[0] += around_count;
        for (std::ptrdiff_t channel = 0; channel < count; ++channel) {
            const std::uint8_t *values = channels[channel] + y * width + begin;
            std::int32_t sum = 0, squares = 0, sum_around = 0, squares_around = 0;
            for (std::ptrdiff_t x = 0; x < wide; ++x) {
                const std::int16_t a = values[x] & mine[x], b = values[x] & around[x];
                sum += a, squares += a * a, sum_around += b, squares_around += b * b;
            }
            to[1 + channel] += sum, to[1 + count + channel] += squares;
            to_around[1 + channel] += sum_around, to_around[1 + count + channel] += squares_around;
        }
    }
}

Integers64 measure_regions(const Bytes &labels, const Integers32 &boxes, const std::vector<Bytes> &channels,
                           int margin) {
    const int height = static_cast<int>(labels.shape(0)), width = static_cast<int>(labels.shape(1));
    const int count = static_cast<int>(channels.size()), fields = 2 * count + 1;
    const pybind11::ssize_t regions = boxes.shape(0);
    Integers64 sums({regions, pybind11::ssize_t(2), pybind11::ssize_t(fields)});
    const std::int32_t *box = boxes.data();
    const std::uint8_t *label = labels.data();
    std::vector<const std::uint8_t *> values;
    for (const Bytes &each : channels) values.push_back(each.data());
    std::int64_t *to = sums.mutable_data();
    pybind11::gil_scoped_release released;
    std::fill(to, to + regions * 2 * fields, 0);
    std::vector<std::uint8_t> masks(2 * static_cast<std::size_t>(width));
    for (pybind11::ssize_t region = 0; region < regions; ++region, box += 4, to += 2 * fields) {
        const int left = std::max(box[0] - margin, 0), right = std::min(box[0] + box[2] + margin, width);
        const int top = std::max(box[1] - margin, 0), bottom = std::min(box[1] + box[3] + margin, height);
        measure_region(label, values.data(), count, width, left, right, top, bottom,
                       static_cast<std::uint8_t>(region + 1), masks.data(), to);
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
SORVOLO_CLONES
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
SORVOLO_CLONES
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
        for (int y = 0; y < std::min(rows, down * step); ++y) {
            const std::uint8_t *line = t0 + (box[1] + y) * padded + box[0];
            for (int phase = 0; phase < step; ++phase) {
                std::uint8_t *one = searched.data() + ((y % step) * step + phase) * phase_size + (y / step) * across;
                for (int x = phase; x < std::min(columns, across * step); x += step) *one++ = line[x];
            }
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

Doubles tree_margins(const Doubles &rows, const Integers32 &asked, const Doubles &thresholds, const Doubles &leaves) {
    const std::ptrdiff_t width = rows.shape(1), trees = asked.shape(0), depth = asked.shape(1);
    Doubles margins({rows.shape(0)});
    const double *row = rows.data(), *first_threshold = thresholds.data(), *first_leaf = leaves.data();
    const std::int32_t *first_asked = asked.data();
    double *to = margins.mutable_data();
    pybind11::gil_scoped_release released;
    for (pybind11::ssize_t each = 0; each < margins.shape(0); ++each, row += width) {
        const std::int32_t *column = first_asked;
        const double *threshold = first_threshold, *leaf = first_leaf;
        double margin = 0.0;
        for (std::ptrdiff_t tree = 0; tree < trees; ++tree, leaf += std::ptrdiff_t{1} << depth) {
            std::ptrdiff_t place = 0;
            for (std::ptrdiff_t level = 0; level < depth; ++level, ++column, ++threshold)
                place = 2 * place + (row[*column] > *threshold);
            margin += leaf[place];
        }
        to[each] = margin;
    }
    return margins;
}

}  // namespace

void bind_robust(pybind11::module_ &module) {
    using pybind11::arg;
    module.def("relight", &relight, arg("image").noconvert(), arg("curves").noconvert(), arg("gains").noconvert(),
               arg("left"), arg("top"), arg("wide"), arg("high"), arg("out").noconvert());
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
    module.def("tree_margins", &tree_margins, arg("rows").noconvert(), arg("asked").noconvert(),
               arg("thresholds").noconvert(), arg("leaves").noconvert());
}

}  // namespace sorvolo
