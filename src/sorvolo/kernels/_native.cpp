// The compiled module, and the kernels of the thesis's change detection. reference.py is their specification.
#include "_native.hpp"

#include <pybind11/stl.h>

#include <cstdlib>
#include <cstring>
#include <optional>
#include <string>
#include <type_traits>

#ifdef SORVOLO_X86
#include <immintrin.h>
#endif

namespace py = pybind11;

namespace sorvolo {

Instructions instructions() {
    static const Instructions best = [] {
        const char *set = std::getenv("SORVOLO_INSTRUCTIONS");
        const std::string allowed = set ? set : "";
#ifdef SORVOLO_X86
        __builtin_cpu_init();
        const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("bmi2");
        const bool avx512 = avx2 && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl") &&
                            __builtin_cpu_supports("avx512dq");
        if (avx512 && allowed != "avx2" && allowed != "plain") return Instructions::avx512;
        if (avx2 && allowed != "plain") return Instructions::avx2;
#endif
        return Instructions::plain;
    }();
    return best;
}

namespace {

constexpr int CHANNELS = 3;

// ---- Equalisation: how often each value occurs, then a table of 256 new values for each channel

void count_values(const std::uint8_t *image, const std::uint8_t *known, std::int64_t pixels, std::int64_t *counts) {
    // Four tables in turn: two equal values in a row would otherwise wait for one another.
    std::vector<std::uint32_t> parts(4 * CHANNELS * 256);
    std::uint32_t *part[4];
    for (int i = 0; i < 4; ++i) part[i] = parts.data() + i * CHANNELS * 256;
    auto add = [&](std::uint32_t *to, const std::uint8_t *pixel) {
        ++to[pixel[0]], ++to[256 + pixel[1]], ++to[512 + pixel[2]];
    };
    std::int64_t i = 0;
    if (known) {
        for (; i < pixels; ++i)
            if (known[i]) add(part[i & 3], image + CHANNELS * i);
    } else {
        for (; i + 4 <= pixels; i += 4)
            for (int k = 0; k < 4; ++k) add(part[k], image + CHANNELS * (i + k));
        for (; i < pixels; ++i) add(part[0], image + CHANNELS * i);
    }
    for (int k = 0; k < 4; ++k)
        for (int value = 0; value < CHANNELS * 256; ++value) counts[value] += part[k][value];
}

void equalising_table(const std::int64_t *counts, std::uint8_t *table) {
    std::int64_t total = 0, below = 0;
    for (int value = 0; value < 256; ++value) total += counts[value];
    int first = 0;
    while (first < 255 && counts[first] == 0) ++first;
    const std::int64_t rest = total - counts[first];
    for (int value = 0; value < 256; ++value) {
        if (value > first) below += counts[value];
        table[value] = static_cast<std::uint8_t>(rest == 0 ? value : (510 * below + rest) / (2 * rest));
    }
}

Bytes equalising_tables(const Bytes &image, const std::optional<Bytes> &known, int threads) {
    const int rows = static_cast<int>(image.shape(0)), columns = static_cast<int>(image.shape(1));
    const std::uint8_t *pixels = image.data(), *mask = known ? known->data() : nullptr;
    Bytes tables({CHANNELS, 256});
    std::uint8_t *table = tables.mutable_data();
    py::gil_scoped_release released;
    std::vector<std::vector<std::int64_t>> counts(std::max(1, std::min(threads, rows)));
    in_bands(static_cast<int>(counts.size()), threads, [&](int from, int to) {
        for (int band = from; band < to; ++band) {
            const std::int64_t bands = counts.size(), size = static_cast<std::int64_t>(rows) * columns;
            const std::int64_t start = size * band / bands, stop = size * (band + 1) / bands;
            counts[band].assign(CHANNELS * 256, 0);
            count_values(pixels + CHANNELS * start, mask ? mask + start : nullptr, stop - start, counts[band].data());
        }
    });
    for (std::size_t band = 1; band < counts.size(); ++band)
        for (int value = 0; value < CHANNELS * 256; ++value) counts[0][value] += counts[band][value];
    for (int channel = 0; channel < CHANNELS; ++channel)
        equalising_table(counts[0].data() + 256 * channel, table + 256 * channel);
    return tables;
}

// ---- Micro-differences removal: the tables applied, the mean over a window, gray

SORVOLO_INLINE std::uint8_t gray_of(int blue, int green, int red) {
    return static_cast<std::uint8_t>((blue * BLUE + green * GREEN + red * RED + GRAY_HALF) >> GRAY_SHIFT);
}

void look_up_row(const std::uint8_t *pixel, const std::uint8_t *tables, int columns, std::uint8_t *row) {
    for (int x = 0; x < columns; ++x, pixel += CHANNELS) {
        row[x] = tables[pixel[0]];
        row[columns + x] = tables[256 + pixel[1]];
        row[2 * columns + x] = tables[512 + pixel[2]];
    }
}

// (sum + area / 2) / area as a multiplication and a shift, exact for sums up to 255 area; 0 where there is no such.
struct Division {
    std::uint32_t factor = 0;
    int shift = 0;

    explicit Division(std::uint32_t area) {
        const std::uint64_t most = 255ull * area + area / 2;
        if (most > 65535) return;
        for (shift = 15; shift >= 0; --shift) {
            const std::uint64_t power = 1ull << (16 + shift), rounded = (power + area - 1) / area;
            if (rounded <= 65535 && (rounded * area - power) * most < power) {
                factor = static_cast<std::uint32_t>(rounded);
                return;
            }
        }
    }
};

struct Averaging {
    const std::uint8_t *image, *tables;
    int rows, columns, width, height;
    std::uint8_t *planes, *gray;
};

template <typename Sum>
SORVOLO_INLINE void average_rows(const Averaging &work, int first, int last) {
    const int columns = work.columns, row_size = CHANNELS * columns, slots = work.height + 1;
    const int above = work.height / 2, below = work.height - 1 - above;
    const int left = work.width / 2, right = work.width - 1 - left;
    const std::uint32_t area = static_cast<std::uint32_t>(work.width) * work.height;
    const Division division(area);
    std::vector<std::uint8_t> ring(static_cast<std::size_t>(slots) * row_size);
    std::vector<Sum> sums(row_size), wide(columns + work.width), spare(columns + work.width), out(columns);
    auto slot = [&](int row) { return ring.data() + static_cast<std::size_t>(row - first + above) % slots * row_size; };
    for (int row = first - above; row < last + below; ++row) {
        const std::uint8_t *fresh = slot(row), *gone = slot(row - work.height + slots);
        look_up_row(work.image + static_cast<std::size_t>(mirrored(row, work.rows)) * row_size, work.tables, columns,
                    slot(row));
        Sum *total = sums.data();
        if (row < first - above + work.height)
            for (int x = 0; x < row_size; ++x) total[x] = static_cast<Sum>(total[x] + fresh[x]);
        else
            for (int x = 0; x < row_size; ++x) total[x] = static_cast<Sum>(total[x] + fresh[x] - gone[x]);
        const int y = row - below;
        if (y < first) continue;
        for (int channel = 0; channel < CHANNELS; ++channel) {
            padded(total + channel * columns, left, right, columns, wide.data());
            slide(wide.data(), spare.data(), work.width, columns, out.data());
            std::uint8_t *mean = work.planes + (static_cast<std::size_t>(channel) * work.rows + y) * columns;
            const Sum *sum = out.data();
            const Sum half = static_cast<Sum>(area / 2);
            if constexpr (std::is_same_v<Sum, std::uint16_t>) {
                const std::uint16_t factor = static_cast<std::uint16_t>(division.factor);
                const int shift = division.shift;
                for (int x = 0; x < columns; ++x) {
                    const std::uint16_t high = static_cast<std::uint16_t>(
                        (static_cast<std::uint32_t>(static_cast<std::uint16_t>(sum[x] + half)) * factor) >> 16);
                    mean[x] = static_cast<std::uint8_t>(high >> shift);
                }
            } else {
                for (int x = 0; x < columns; ++x) mean[x] = static_cast<std::uint8_t>((sum[x] + half) / area);
            }
        }
        const std::uint8_t *blue = work.planes + static_cast<std::size_t>(y) * columns;
        const std::uint8_t *green = blue + static_cast<std::size_t>(work.rows) * columns;
        const std::uint8_t *red = green + static_cast<std::size_t>(work.rows) * columns;
        std::uint8_t *gray = work.gray + static_cast<std::size_t>(y) * columns;
        for (int x = 0; x < columns; ++x) gray[x] = gray_of(blue[x], green[x], red[x]);
    }
}

SORVOLO_CLONES void average_rows_16(const Averaging &work, int first, int last) {
    average_rows<std::uint16_t>(work, first, last);
}

SORVOLO_CLONES void average_rows_32(const Averaging &work, int first, int last) {
    average_rows<std::uint32_t>(work, first, last);
}

py::tuple averaged(const Bytes &image, const Bytes &tables, int width, int height, int threads) {
    const py::ssize_t rows = image.shape(0), columns = image.shape(1);
    Bytes planes({static_cast<py::ssize_t>(CHANNELS), rows, columns}), gray({rows, columns});
    const Averaging work{image.data(), tables.data(), static_cast<int>(rows), static_cast<int>(columns), width, height,
                         planes.mutable_data(), gray.mutable_data()};
    {
        py::gil_scoped_release released;
        const bool fits = Division(static_cast<std::uint32_t>(width) * height).factor != 0;
        in_bands(work.rows, threads, [&](int first, int last) {
            fits ? average_rows_16(work, first, last) : average_rows_32(work, first, last);
        });
    }
    return py::make_tuple(planes, gray);
}

// ---- RGB-LBP: of the pixels in question, those whose binary strings differ in more than `most` bits

struct Strings {
    const std::uint8_t *reference, *query, *asked;
    int rows, columns, width, height, most;
    std::uint8_t *out;
};

constexpr int BLOCK = 64, LANES = 16, ROWS = 2;

// One image's neighbourhood of a block of pixels: the rows dy of channel 0, the others a step further each.
struct Window {
    const std::uint8_t *const *rows;
    std::ptrdiff_t channel_step, across;

    SORVOLO_INLINE const std::uint8_t *row(int channel, int dy) const {
        return rows[dy] + channel * channel_step + across;
    }
    SORVOLO_INLINE Window below(int down) const { return {rows + down, channel_step, across}; }
};

// How many bits differ for each of 64 pixels in a row; bytes count up to 255 before they are added up.
using CountBlock = void (*)(const Strings &, const Window &, const Window &, std::uint16_t *);

// The same for 64 pixels in each of two rows, one upon the other.
template <CountBlock count_block>
void count_each(const Strings &work, const Window &reference, const Window &query, std::uint16_t *counts) {
    for (int k = 0; k < ROWS; ++k) count_block(work, reference.below(k), query.below(k), counts + k * BLOCK);
}

SORVOLO_INLINE void add_up(std::uint16_t *counts, const std::uint8_t *bits) {
    for (int x = 0; x < BLOCK; ++x) counts[x] = static_cast<std::uint16_t>(counts[x] + bits[x]);
}

void count_block_plain(const Strings &work, const Window &reference, const Window &query, std::uint16_t *counts) {
    const int left = work.width / 2, above = work.height / 2;
    std::memset(counts, 0, BLOCK * sizeof(std::uint16_t));
    for (int channel = 0; channel < CHANNELS; ++channel) {
        const std::uint8_t *centre_r = reference.row(channel, above) + left;
        const std::uint8_t *centre_q = query.row(channel, above) + left;
        for (int dy = 0; dy < work.height; ++dy) {
            const std::uint8_t *row_r = reference.row(channel, dy), *row_q = query.row(channel, dy);
            std::uint8_t bits[BLOCK] = {};
            for (int dx = 0; dx < work.width; ++dx)
                for (int x = 0; x < BLOCK; ++x)
                    bits[x] = static_cast<std::uint8_t>(
                        bits[x] + ((row_r[dx + x] >= centre_r[x]) ^ (row_q[dx + x] >= centre_q[x])));
            add_up(counts, bits);
        }
    }
}

#ifdef SORVOLO_X86
#define SORVOLO_LOAD(from) _mm256_loadu_si256(reinterpret_cast<const __m256i *>(from))

SORVOLO_AVX2 void count_block_avx2(const Strings &work, const Window &reference, const Window &query,
                                   std::uint16_t *counts) {
    const int left = work.width / 2, above = work.height / 2;
    std::memset(counts, 0, BLOCK * sizeof(std::uint16_t));
    for (int half = 0; half < BLOCK; half += 32)
        for (int channel = 0; channel < CHANNELS; ++channel) {
            const __m256i centre_r = SORVOLO_LOAD(reference.row(channel, above) + left + half);
            const __m256i centre_q = SORVOLO_LOAD(query.row(channel, above) + left + half);
            for (int dy = 0; dy < work.height; ++dy) {
                const std::uint8_t *row_r = reference.row(channel, dy) + half, *row_q = query.row(channel, dy) + half;
                __m256i bits = _mm256_setzero_si256();
                for (int dx = 0; dx < work.width; ++dx) {
                    const __m256i r = SORVOLO_LOAD(row_r + dx), q = SORVOLO_LOAD(row_q + dx);
                    const __m256i at_least_r = _mm256_cmpeq_epi8(_mm256_max_epu8(r, centre_r), r);
                    const __m256i at_least_q = _mm256_cmpeq_epi8(_mm256_max_epu8(q, centre_q), q);
                    bits = _mm256_sub_epi8(bits, _mm256_xor_si256(at_least_r, at_least_q));
                }
                alignas(32) std::uint8_t each[32];
                _mm256_store_si256(reinterpret_cast<__m256i *>(each), bits);
                for (int x = 0; x < 32; ++x)
                    counts[half + x] = static_cast<std::uint16_t>(counts[half + x] + each[x]);
            }
        }
}

// One to two rows of pixels: what is around both is read once.
template <int rows>
SORVOLO_AVX512 void count_block_avx512(const Strings &work, const Window &reference, const Window &query,
                                       std::uint16_t *counts) {
    const int left = work.width / 2, above = work.height / 2;
    const __m512i one = _mm512_set1_epi8(1);
    std::memset(counts, 0, rows * BLOCK * sizeof(std::uint16_t));
    for (int channel = 0; channel < CHANNELS; ++channel) {
        __m512i centre_r[rows], centre_q[rows], bits[rows];
        for (int k = 0; k < rows; ++k) {
            centre_r[k] = _mm512_loadu_si512(reference.row(channel, above + k) + left);
            centre_q[k] = _mm512_loadu_si512(query.row(channel, above + k) + left);
            bits[k] = _mm512_setzero_si512();
        }
        int added = 0;
        for (int dy = 0; dy < work.height + rows - 1; ++dy) {
            const std::uint8_t *row_r = reference.row(channel, dy), *row_q = query.row(channel, dy);
            const auto count = [&](int first, int last) SORVOLO_AVX512 __attribute__((always_inline)) {
                for (int dx = 0; dx < work.width; ++dx) {
                    const __m512i r = _mm512_loadu_si512(row_r + dx), q = _mm512_loadu_si512(row_q + dx);
                    for (int k = first; k < last; ++k) {
                        const __m512i less_r = _mm512_min_epu8(_mm512_subs_epu8(centre_r[k], r), one);
                        const __m512i less_q = _mm512_min_epu8(_mm512_subs_epu8(centre_q[k], q), one);
                        bits[k] = _mm512_add_epi8(bits[k], _mm512_xor_si512(less_r, less_q));
                    }
                }
            };
            if (rows == 1 || (dy > 0 && dy < work.height)) count(0, rows);
            else if (dy == 0) count(0, 1);
            else count(rows - 1, rows);
            added += work.width;
            if (added + work.width <= 255 && dy + 2 < work.height + rows) continue;
            for (int k = 0; k < rows; ++k) {
                alignas(64) std::uint8_t each[BLOCK];
                _mm512_store_si512(each, bits[k]);
                add_up(counts + k * BLOCK, each);
                bits[k] = _mm512_setzero_si512();
            }
            added = 0;
        }
    }
}
#endif

struct Counting {
    CountBlock one_row, two_rows;
};

Counting best_counting() {
#ifdef SORVOLO_X86
    if (instructions() == Instructions::avx512) return {count_block_avx512<1>, count_block_avx512<ROWS>};
    if (instructions() == Instructions::avx2) return {count_block_avx2, count_each<count_block_avx2>};
#endif
    return {count_block_plain, count_each<count_block_plain>};
}

// How many bits differ for one pixel, for windows up to 16 wide and 255 high.
SORVOLO_INLINE int count_pixel(const Strings &work, const Window &reference, const Window &query) {
    const int left = work.width / 2, above = work.height / 2;
    std::uint8_t inside[LANES];
    for (int x = 0; x < LANES; ++x) inside[x] = x < work.width;
    int total = 0;
    for (int channel = 0; channel < CHANNELS; ++channel) {
        const std::uint8_t centre_r = reference.row(channel, above)[left], centre_q = query.row(channel, above)[left];
        std::uint8_t bits[LANES] = {};
        for (int dy = 0; dy < work.height; ++dy) {
            const std::uint8_t *row_r = reference.row(channel, dy), *row_q = query.row(channel, dy);
            for (int x = 0; x < LANES; ++x)
                bits[x] = static_cast<std::uint8_t>(
                    bits[x] + (((row_r[x] >= centre_r) ^ (row_q[x] >= centre_q)) & inside[x]));
        }
        for (int x = 0; x < LANES; ++x) total += bits[x];
    }
    return total;
}

// The rows of both images that the windows around two rows reach, mirrored over the rims, each copied once on its way.
class NearRows {
public:
    NearRows(const Strings &work)
        : work_(work), step_(work.columns + work.width + BLOCK + LANES), slots_(work.height + ROWS - 1),
          bytes_(2 * CHANNELS * static_cast<std::size_t>(step_) * slots_), held_(slots_, -work.rows - 1000),
          reference_(slots_), query_(slots_) {}

    void around(int y) {
        for (int dy = 0; dy < slots_; ++dy) {
            const int row = y - work_.height / 2 + dy;
            const int slot = ((row % slots_) + slots_) % slots_;
            std::uint8_t *start = bytes_.data() + 2 * CHANNELS * static_cast<std::size_t>(step_) * slot;
            reference_[dy] = start;
            query_[dy] = start + CHANNELS * static_cast<std::size_t>(step_);
            if (held_[slot] == row) continue;
            held_[slot] = row;
            for (int channel = 0; channel < CHANNELS; ++channel, start += step_) {
                const std::size_t from =
                    (static_cast<std::size_t>(channel) * work_.rows + mirrored(row, work_.rows)) * work_.columns;
                const int left = work_.width / 2, right = work_.width - 1 - left;
                padded(work_.reference + from, left, right, work_.columns, start);
                padded(work_.query + from, left, right, work_.columns, start + CHANNELS * step_);
            }
        }
    }
    Window reference(int across) const { return {reference_.data(), step_, across}; }
    Window query(int across) const { return {query_.data(), step_, across}; }

private:
    const Strings &work_;
    std::ptrdiff_t step_;
    int slots_;
    std::vector<std::uint8_t> bytes_;
    std::vector<int> held_;  // the row that each slot holds
    std::vector<const std::uint8_t *> reference_, query_;
};

constexpr int FEW = 4;  // pixels in question in a block of 64: with fewer one by one is faster

void compare_rows(const Strings &work, int first, int last) {
    const Counting counting = best_counting();
    const bool one_by_one = work.width <= LANES && work.height <= 255;
    NearRows near(work);
    std::uint16_t counts[ROWS * BLOCK];
    for (int y = first; y < last; y += ROWS) {
        const int rows = std::min(ROWS, last - y);
        bool prepared = false;
        for (int x0 = 0; x0 < work.columns; x0 += BLOCK) {
            const int pixels = std::min(BLOCK, work.columns - x0);
            const std::size_t at = static_cast<std::size_t>(y) * work.columns + x0;
            int wanted[ROWS] = {};
            for (int k = 0; k < rows; ++k)
                for (int x = 0; x < pixels; ++x) wanted[k] += work.asked[at + k * work.columns + x] != 0;
            if (*std::max_element(wanted, wanted + rows) == 0) continue;
            if (!prepared) near.around(y);
            prepared = true;
            const int few = one_by_one ? FEW : 1;
            const bool together = rows == ROWS && *std::min_element(wanted, wanted + ROWS) >= few;
            if (together) counting.two_rows(work, near.reference(x0), near.query(x0), counts);
            for (int k = 0; k < rows; ++k) {
                const std::uint8_t *asked = work.asked + at + k * work.columns;
                std::uint8_t *out = work.out + at + k * work.columns, *end = out + pixels;
                std::uint16_t *count = counts + k * BLOCK;
                if (wanted[k] < few) {
                    for (int x = 0; x < pixels && wanted[k] > 0; ++x)
                        if (asked[x]) count[x] = static_cast<std::uint16_t>(count_pixel(
                            work, near.reference(x0 + x).below(k), near.query(x0 + x).below(k)));
                } else if (!together) {
                    counting.one_row(work, near.reference(x0).below(k), near.query(x0).below(k), count);
                }
                for (; out < end; ++out, ++asked, ++count) *out = *asked && *count > work.most ? 255 : 0;
            }
        }
    }
}

Bytes texture_changes(const Bytes &reference, const Bytes &query, const Bytes &asked, int width, int height, int most,
                      int threads) {
    Bytes changes({asked.shape(0), asked.shape(1)});
    const Strings work{reference.data(), query.data(), asked.data(), static_cast<int>(asked.shape(0)),
                       static_cast<int>(asked.shape(1)), width, height, most, changes.mutable_data()};
    py::gil_scoped_release released;
    std::memset(work.out, 0, static_cast<std::size_t>(work.rows) * work.columns);
    in_bands(work.rows, threads, [&](int first, int last) { compare_rows(work, first, last); });
    return changes;
}

}  // namespace
}  // namespace sorvolo

PYBIND11_MODULE(_native, module) {
    module.doc() = "The kernels, compiled; sorvolo.kernels is the door to them.";
    using namespace sorvolo;
    auto array = [](const char *name) { return py::arg(name).noconvert(); };
    module.def("equalising_tables", &equalising_tables, array("image"), array("known"), py::arg("threads"));
    module.def("averaged", &averaged, array("image"), array("tables"), py::arg("width"), py::arg("height"),
               py::arg("threads"));
    module.def("texture_changes", &texture_changes, array("reference"), array("query"), array("asked"),
               py::arg("width"), py::arg("height"), py::arg("most"), py::arg("threads"));
    bind_regions(module);
    bind_robust(module);
    bind_differences(module);
    bind_light(module);
    bind_heights(module);
}
