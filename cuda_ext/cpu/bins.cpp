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

template <class S>
Record<S> make_record(const S* mean, const S* form, S opacity, const Cutoffs& cutoffs) {
    const S w = form[0] > S(1e-30) ? form[0] : S(1e-30), m = form[1], v = form[2];
    const S reach2 = cutoffs.reach2(opacity);
    const S turn = std::sqrt(reach2) * m / (v * std::sqrt(S(1) / w + m * m / v));
    return {mean[0], mean[1], m, opacity, w * S(kExponentScale), v * S(kExponentScale), reach2, turn};
}

// Pixels [first, last] of `size` whose centres lie in [low, high], relative to the first pixel's centre.
template <class S>
void clip(S low, S high, int64_t size, int64_t& first, int64_t& last) {
    first = !(low > S(0)) ? 0 : low > S(size) ? size : int64_t(std::ceil(low));
    last = !(high < S(size - 1)) ? size - 1 : high < S(0) ? -1 : int64_t(std::floor(high));
}

}  // namespace

template <class S>
TileRange Bins<S>::range(const Record<S>& r) const {
    const S w = r.w(), v = r.v();
    const S x = r.mean_x - (S(window.x0) + S(0.5)), y = r.mean_y - (S(window.y0) + S(0.5));
    const S reach_x = std::sqrt(r.reach2 * (S(1) / w + r.m * r.m / v)) + margin(r.mean_x);
    const S reach_y = std::sqrt(r.reach2 / v) + margin(r.mean_y);
    int64_t x0, x1, y0, y1;
    clip(x - reach_x, x + reach_x, window.width, x0, x1);
    clip(y - reach_y, y + reach_y, window.height, y0, y1);
    if (x1 < x0 || y1 < y0 || !(r.reach2 > S(0))) return {1, 0, 1, 0};
    return {uint16_t(x0 / kTile), uint16_t(x1 / kTile), uint16_t(y0 / kTile), uint16_t(y1 / kTile)};
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
        for (int64_t i = part_begin(part); i < end; ++i) {
            if (i + 16 < end) __builtin_prefetch(splats_.opacities + splats_.visible[i + 16]);
            headers_[i] = make_record(
                splats_.means + 2 * i, splats_.forms + 3 * i, splats_.opacities[splats_.visible[i]], cutoffs_);
            ranges_[i] = range(headers_[i]);
            each_tile(i, [&](int64_t tile) { ++counts[tile]; });
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
