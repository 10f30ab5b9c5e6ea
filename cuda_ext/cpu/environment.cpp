#include "../math/environment.h"

#include <algorithm>
#include <cstring>
#include <vector>

#include "guarded.h"
#include "scratch.h"
#include "threads.h"

namespace catacaustics {
namespace {

// Directions, and rows of the table, in one task.
constexpr int64_t kChunk = 1024, kBand = 4;

template <class S>
struct Lookup {
    int64_t count, height, width, channels;
    const S *table, *rows, *columns;

    Texels<S> texels(int64_t i) const { return {rows[i], columns[i], height, width}; }
    const S* texel(int64_t row, int64_t column) const { return table + (row * width + column) * channels; }
};

template <class F>
void for_chunks(int64_t count, int threads, F&& function) {
    parallel_for(threads, (count + kChunk - 1) / kChunk, [&](int64_t chunk) {
        for (int64_t i = chunk * kChunk; i < std::min(count, (chunk + 1) * kChunk); ++i) function(i);
    });
}

template <class S>
int64_t look_up(const Lookup<S>& at, int threads, S* found) {
    for_chunks(at.count, threads, [&](int64_t i) {
        const Texels<S> t = at.texels(i);
        const S *a = at.texel(t.row[0], t.column[0]), *b = at.texel(t.row[0], t.column[1]);
        const S *c = at.texel(t.row[1], t.column[0]), *d = at.texel(t.row[1], t.column[1]);
        const S shares[4] = {t.share(0, 0), t.share(0, 1), t.share(1, 0), t.share(1, 1)};
        for (int64_t k = 0; k < at.channels; ++k)
            found[i * at.channels + k] = shares[0] * a[k] + shares[1] * b[k] + shares[2] * c[k] + shares[3] * d[k];
    });
    return 0;
}

// Gradients to where the table was read; either may be null.
template <class S>
void place_gradients(const Lookup<S>& at, const S* g_found, int threads, S* g_rows, S* g_columns) {
    for_chunks(at.count, threads, [&](int64_t i) {
        const Texels<S> t = at.texels(i);
        const S *a = at.texel(t.row[0], t.column[0]), *b = at.texel(t.row[0], t.column[1]);
        const S *c = at.texel(t.row[1], t.column[0]), *d = at.texel(t.row[1], t.column[1]);
        S g_row = 0, g_column = 0;
        for (int64_t k = 0; k < at.channels; ++k) {
            const S g = g_found[i * at.channels + k];
            g_row += g * ((S(1) - t.right_share) * (c[k] - a[k]) + t.right_share * (d[k] - b[k]));
            g_column += g * ((S(1) - t.lower_share) * (b[k] - a[k]) + t.lower_share * (d[k] - c[k]));
        }
        if (g_rows) g_rows[i] = g_row;
        if (g_columns) g_columns[i] = g_column;
    });
}

// A task clears some rows of the table's gradient and adds what directions give to them, in the order of directions: the
// sums do not depend on the threads.
template <class S>
void table_gradient(const Lookup<S>& at, const S* g_found, int threads, S* g_table) {
    const int64_t bands = (at.height + kBand - 1) / kBand;
    std::vector<int64_t> starts(bands + 1, 0);
    const auto for_bands = [&](int64_t i, auto&& function) {
        const Texels<S> t = at.texels(i);
        function(t.row[0] / kBand);
        if (t.row[1] / kBand != t.row[0] / kBand) function(t.row[1] / kBand);
    };
    for (int64_t i = 0; i < at.count; ++i) for_bands(i, [&](int64_t band) { ++starts[band + 1]; });
    for (int64_t band = 0; band < bands; ++band) starts[band + 1] += starts[band];
    Scratch<int64_t> listed(starts[bands]);
    std::vector<int64_t> next(starts.begin(), starts.end() - 1);
    for (int64_t i = 0; i < at.count; ++i) for_bands(i, [&](int64_t band) { listed[next[band]++] = i; });
    parallel_for(threads, bands, [&](int64_t band) {
        const int64_t first = band * kBand, last = std::min(at.height, first + kBand), row = at.width * at.channels;
        std::memset(g_table + first * row, 0, (last - first) * row * sizeof(S));
        for (int64_t k = starts[band]; k < starts[band + 1]; ++k) {
            const Texels<S> t = at.texels(listed[k]);
            const S* g = g_found + listed[k] * at.channels;
            for (int i = 0; i < 2; ++i) {
                if (t.row[i] < first || t.row[i] >= last) continue;
                for (int j = 0; j < 2; ++j) {
                    S* to = g_table + t.row[i] * row + t.column[j] * at.channels;
                    for (int64_t c = 0; c < at.channels; ++c) to[c] += t.share(i, j) * g[c];
                }
            }
        }
    });
}

}  // namespace

// Features of `count` fractional places of a table (height, width, channels), found (count, channels). The backward pass
// writes gradients to the table and to the places; those that are null are not computed.
#define CATACAUSTICS_ENVIRONMENT(S, SUFFIX)                                                                         \
    CATACAUSTICS_EXPORT int64_t catacaustics_environment_##SUFFIX(                                                  \
        const Run* run, int64_t count, int64_t height, int64_t width, int64_t channels, const S* table,             \
        const S* rows, const S* columns, S* found) {                                                                \
        return guarded([&] {                                                                                        \
            return look_up<S>({count, height, width, channels, table, rows, columns}, int(run->threads), found);    \
        });                                                                                                         \
    }                                                                                                               \
    CATACAUSTICS_EXPORT int64_t catacaustics_environment_backward_##SUFFIX(                                         \
        const Run* run, int64_t count, int64_t height, int64_t width, int64_t channels, const S* table,             \
        const S* rows, const S* columns, const S* g_found, S* g_table, S* g_rows, S* g_columns) {                   \
        return guarded([&] {                                                                                        \
            const Lookup<S> at{count, height, width, channels, table, rows, columns};                               \
            const int threads = int(run->threads);                                                                  \
            if (g_table) table_gradient(at, g_found, threads, g_table);                                             \
            if (g_rows || g_columns) place_gradients(at, g_found, threads, g_rows, g_columns);                      \
            return int64_t(0);                                                                                      \
        });                                                                                                         \
    }

CATACAUSTICS_ENVIRONMENT(float, f32)
CATACAUSTICS_ENVIRONMENT(double, f64)

}  // namespace catacaustics
