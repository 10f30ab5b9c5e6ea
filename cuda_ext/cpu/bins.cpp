#include "bins.h"

#include <algorithm>
#include <cmath>
#include <cstring>

namespace catacaustics {
namespace {

// Room for rounding: which pixels are drawn is decided pixel by pixel, a tile too many does no harm.
template <class S>
S margin(S coordinate) {
    return S(0.01) + S(4e-7) * std::abs(coordinate);
}

// Pixels [first, last] of `size` whose centres lie in [low, high], relative to the first pixel's centre.
template <class S>
void clip(S low, S high, int64_t size, int64_t& first, int64_t& last) {
    first = !(low > S(0)) ? 0 : low > S(size) ? size : int64_t(std::ceil(low));
    last = !(high < S(size - 1)) ? size - 1 : high < S(0) ? -1 : int64_t(std::floor(high));
}

}  // namespace

// Headers and tiles of the splats [begin, begin + lanes) that are before `end`, all lanes at once.
template <class S>
void Bins<S>::make_headers(int64_t begin, int64_t end) {
    using P = Pack<S>;
    constexpr int lanes = P::size;
    const int here = int(std::min<int64_t>(lanes, end - begin));
    alignas(64) S in[7][lanes], out[8][lanes];
    for (int lane = 0; lane < lanes; ++lane) {
        const int64_t i = begin + std::min(lane, here - 1);
        for (int k = 0; k < 2; ++k) in[k][lane] = splats_.means[2 * i + k];
        for (int k = 0; k < 3; ++k) in[2 + k][lane] = splats_.forms[3 * i + k];
        in[5][lane] = splats_.opacities[splats_.visible[i]];
        in[6][lane] = cutoffs_.reach2(in[5][lane]);
    }
    const P zero(S(0)), tiny(S(1e-30));
    const P mean_x = P::load(in[0]), mean_y = P::load(in[1]), m = P::load(in[3]), v = P::load(in[4]);
    const P w = select(P::load(in[2]) > tiny, P::load(in[2]), tiny), reach2 = P::load(in[6]);
    const P variance_x = P(S(1)) / w + m * m / v;
    const P reach_x = square_root(reach2 * variance_x), reach_y = square_root(reach2 / v);
    const P turn = reach2 * m / (v * select(reach_x > tiny, reach_x, tiny));
    const P scaled_w = w * P(S(kExponentScale)), scaled_v = v * P(S(kExponentScale));
    // Pixels whose centres lie within the reach, clamped so that they fit an integer; not-a-numbers give all pixels.
    const auto clip = [&](P mean, P reach, int64_t start, int64_t size, S* first, S* last) {
        const P margin = P(S(0.01)) + P(S(4e-7)) * select(mean < zero, -mean, mean);
        const P middle = mean - P(S(start) + S(0.5)), most = P(S(size - 1)), outside = P(S(size));
        P low = middle - reach - margin, high = middle + reach + margin;
        low = select(low > zero, low, zero);
        select(low < outside, low, outside).store(first);
        high = select(high < most, high, most);
        select(high > P(S(-1)), high, P(S(-1))).store(last);
    };
    clip(mean_x, reach_x, window.x0, window.width, out[0], out[1]);
    clip(mean_y, reach_y, window.y0, window.height, out[2], out[3]);
    turn.store(out[4]);
    scaled_w.store(out[5]);
    scaled_v.store(out[6]);
    for (int lane = 0; lane < here; ++lane) {
        headers_[begin + lane] = {in[0][lane],  in[1][lane],  in[3][lane], in[5][lane],
                                  out[5][lane], out[6][lane], in[6][lane], out[4][lane]};
        // Rounding to the tile of the pixel before is harmless.
        const bool none = out[1][lane] < S(0) || out[3][lane] < S(0) || out[0][lane] >= S(window.width) ||
                          out[2][lane] >= S(window.height) || !(in[6][lane] > S(0));
        ranges_[begin + lane] = none ? TileRange{1, 0, 1, 0}
                                     : TileRange{
                                           uint16_t(int(out[0][lane]) / kTile), uint16_t(int(out[1][lane]) / kTile),
                                           uint16_t(int(out[2][lane]) / kTile), uint16_t(int(out[3][lane]) / kTile)};
    }
}

template <class S>
template <class F>
void Bins<S>::each_tile(int64_t splat, F&& function) const {
    const TileRange t = ranges_[splat];
    const int64_t columns = window.tiles_x();
    // An ellipse over many tiles leaves out the corners of its bounding box.
    const bool trim = t.x1 > t.x0 + 1 && t.y1 > t.y0;
    for (int64_t row = t.y0; row <= t.y1; ++row) {
        int64_t first = t.x0, last = t.x1;
        if (trim) {
            const Record<S>& r = headers_[splat];
            const S w = r.w(), v = r.v();
            const S low = S(window.y0 + row * kTile) + S(0.5) - r.mean_y - margin(r.mean_y);
            S left, right;
            row_extent(
                low, low + S(kTile - 1) + S(2) * margin(r.mean_y), std::sqrt(r.reach2 / v), r.turn, r.reach2, r.m, v,
                S(1) / w, left, right);
            const S x = r.mean_x - (S(window.x0) + S(0.5)), room = margin(r.mean_x);
            int64_t x0, x1;
            clip(x + left - room, x + right + room, window.width, x0, x1);
            first = std::max(first, x0 / kTile);
            last = x1 < x0 ? first - 1 : std::min(last, x1 / kTile);
        }
        for (int64_t column = first; column <= last; ++column) function(row * columns + column);
    }
}

template <class S>
Bins<S>::Bins(const Splats<S>& splats, const Window& window, const Cutoffs& cutoffs, int threads)
    : window(window), splats_(splats), cutoffs_(cutoffs), threads_(threads) {
    parts_ = std::max<int64_t>(1, std::min<int64_t>(threads, splats.count / 1024));
    headers_.allocate(splats.count);
    ranges_.allocate(splats.count);
    const int64_t tiles = window.tiles();
    counts_.assign(parts_ * tiles, 0);
    parallel_for(threads_, parts_, [&](int64_t part) {
        int32_t* counts = counts_.data() + part * tiles;
        const int64_t end = part_begin(part + 1);
        for (int64_t begin = part_begin(part); begin < end; begin += Pack<S>::size) {
            make_headers(begin, end);
            for (int64_t i = begin; i < std::min(end, begin + Pack<S>::size); ++i) {
                if (i + 64 < end) __builtin_prefetch(splats_.opacities + splats_.visible[i + 64]);
                each_tile(i, [&](int64_t tile) { ++counts[tile]; });
            }
        }
    });
    starts_.resize(tiles + 1);
    int64_t total = 0;
    for (int64_t tile = 0; tile < tiles; ++tile) {
        starts_[tile] = total;
        int32_t before = 0;
        for (int64_t part = 0; part < parts_; ++part) {
            int32_t& count = counts_[part * tiles + tile];
            const int32_t own = count;
            count = before;
            before += own;
        }
        total += before;
    }
    starts_[tiles] = total;
}

template <class S>
void Bins<S>::pack(int first, int channels) {
    const int64_t stride = record_stride(channels);
    if (stride != stride_) records_.allocate(splats_.count * stride);
    stride_ = stride;
    const int64_t chunk = 4096;
    parallel_for(threads_, (splats_.count + chunk - 1) / chunk, [&](int64_t task) {
        const int64_t end = std::min(splats_.count, (task + 1) * chunk);
        for (int64_t i = task * chunk; i < end; ++i) {
            if (i + 16 < end) __builtin_prefetch(splats_.features + splats_.visible[i + 16] * splats_.channels + first);
            S* record = records_.data() + i * stride;
            std::memcpy(record, &headers_[i], sizeof(Record<S>));
            const S* features = splats_.features + splats_.visible[i] * splats_.channels + first;
            for (int c = 0; c < channels; ++c) record[kHeader + c] = features[c];
        }
    });
}

template <class S>
int64_t Bins<S>::batch_end(int64_t first, int64_t limit) const {
    const auto past = std::upper_bound(starts_.begin() + first, starts_.end(), starts_[first] + limit);
    return std::max(first + 1, int64_t(past - starts_.begin()) - 1);
}

template <class S>
void Bins<S>::list(int64_t first_tile, int64_t last_tile) {
    base_ = starts_[first_tile];
    entries_.allocate(starts_[last_tile] - base_);
    const int64_t tiles = window.tiles();
    const bool all = first_tile == 0 && last_tile == tiles;
    parallel_for(threads_, parts_, [&](int64_t part) {
        std::vector<int64_t> next(last_tile - first_tile);
        for (int64_t tile = first_tile; tile < last_tile; ++tile)
            next[tile - first_tile] = starts_[tile] - base_ + counts_[part * tiles + tile];
        for (int64_t i = part_begin(part); i < part_begin(part + 1); ++i)
            each_tile(i, [&](int64_t tile) {
                if (all || (tile >= first_tile && tile < last_tile))
                    entries_[next[tile - first_tile]++] = int32_t(i);
            });
    });
}

template class Bins<float>;
template class Bins<double>;

}  // namespace catacaustics
