#include "../math/adam.h"

#include <algorithm>
#include <cmath>

#include "guarded.h"
#include "simd.h"
#include "threads.h"

namespace catacaustics {
namespace {

// Rows, or values, in one task.
constexpr int64_t kChunk = 4096;
// Rows that are looked at together: most rows of a large cloud have no gradient.
constexpr int64_t kBlock = 16;

// beta^k. Whole k below 2^16 take two look-ups, beta^(k % 256) and beta^(256 (k / 256)).
class Powers {
   public:
    explicit Powers(double beta) : beta_(beta) {
        low_[0] = high_[0] = 1;
        for (int i = 1; i < 256; ++i) low_[i] = low_[i - 1] * beta;
        for (int i = 1; i < 256; ++i) high_[i] = high_[i - 1] * (low_[255] * beta);
    }
    double operator()(float k) const {
        if (!(k >= 0 && k < 65536)) return std::pow(beta_, double(k));
        const int whole = int(k);
        return float(whole) == k ? low_[whole & 255] * high_[whole >> 8] : std::pow(beta_, double(k));
    }

   private:
    double beta_, low_[256], high_[256];
};

template <class S>
struct Parameter {
    const S* gradient;
    S *value, *mean, *square;
};

struct Rates {
    double lr, beta1, beta2, eps, weight_decay;

    template <class T>
    AdamSettings<T> settings() const {
        return {T(1 - beta1), T(1 - beta2), T(beta2), T(1 - lr * weight_decay), T(eps)};
    }
};

// Neither 0 nor -0: denormal numbers count, and values that are not numbers.
template <class S>
CATACAUSTICS_HD bool any_set(const S* values, int64_t count) {
    SortKey<S> bits = 0;
    for (int64_t i = 0; i < count; ++i) bits |= SortKey<S>(bits_of(values[i])) << 1;
    return bits != 0;
}

// All values together in one step.
template <class S>
void step_values(const Parameter<S>& p, const Rates& rates, S rate, int64_t begin, int64_t end) {
    using P = Pack<S>;
    const auto settings = rates.settings<P>();
    int64_t i = begin;
    for (; i + P::size <= end; i += P::size) {
        P gradient, value, mean, square;  // arrays of torch's may lie anywhere
        std::memcpy(&gradient, p.gradient + i, sizeof gradient);
        std::memcpy(&value, p.value + i, sizeof value);
        std::memcpy(&mean, p.mean + i, sizeof mean);
        std::memcpy(&square, p.square + i, sizeof square);
        adam_step(settings, P(rate), gradient, value, mean, square);
        std::memcpy(p.value + i, &value, sizeof value);
        std::memcpy(p.mean + i, &mean, sizeof mean);
        std::memcpy(p.square + i, &square, sizeof square);
    }
    for (; i < end; ++i)
        adam_step(rates.settings<S>(), rate, p.gradient[i], p.value[i], p.mean[i], p.square[i]);
}

// Lists the rows of [begin, end) that have a gradient; known_width is 0, or the width. No branch on a row: which ones
// have a gradient cannot be foreseen.
template <int known_width, class S>
int list_rows(const S* gradient, int64_t some_width, int64_t begin, int64_t end, int64_t* rows) {
    const int64_t width = known_width ? known_width : some_width;
    int count = 0;
    for (int64_t first = begin; first < end; first += kBlock) {
        const int64_t last = std::min(first + kBlock, end);
        if (!any_set(gradient + first * width, (last - first) * width)) continue;
        for (int64_t row = first; row < last; ++row) {
            rows[count] = row;
            count += any_set(gradient + row * width, width);
        }
    }
    return count;
}

// The rows listed, a lane each; every row counts its own steps.
template <class S>
void step_rows(
    const Parameter<S>& p, float* steps, const S* row_rates, const Rates& rates, const Powers& power1,
    const Powers& power2, int64_t width, const int64_t* rows, int count) {
    using P = Pack<S>;
    const auto settings = rates.settings<P>();
    alignas(64) S scale[P::size], first[P::size], second[P::size];
    alignas(64) S gradient[P::size], value[P::size], mean[P::size], square[P::size];
    for (int k = 0; k < count; k += P::size) {
        for (int ahead = k + 2 * P::size; ahead < std::min(count, k + 3 * P::size); ++ahead) {
            const int64_t from = rows[ahead] * width;
            const S* const arrays[4] = {p.gradient, p.value, p.mean, p.square};
            for (const S* values : arrays) {
                __builtin_prefetch(values + from, 1);
                if (width > 1) __builtin_prefetch(values + from + width - 1, 1);  // mostly the same cache line
            }
            __builtin_prefetch(steps + rows[ahead], 1);
        }
        const int here = std::min<int>(P::size, count - k);
        int64_t from[P::size];
        for (int lane = 0; lane < P::size; ++lane) {
            const int64_t row = rows[k + std::min(lane, here - 1)];
            const float step = steps[row] + (lane < here ? 1.0f : 0.0f);
            steps[row] = step;
            from[lane] = row * width;
            scale[lane] = row_rates ? row_rates[row] : S(1);
            first[lane] = S(1 - power1(step));
            second[lane] = S(1 - power2(step));
        }
        const P rate = P(rates.lr) * P::load(scale) * square_root(P::load(second)) / P::load(first);
        for (int64_t column = 0; column < width; ++column) {
            for (int lane = 0; lane < P::size; ++lane) {
                const int64_t i = from[lane] + column;
                gradient[lane] = p.gradient[i];
                value[lane] = p.value[i];
                mean[lane] = p.mean[i];
                square[lane] = p.square[i];
            }
            P v = P::load(value), m = P::load(mean), s = P::load(square);
            adam_step(settings, rate, P::load(gradient), v, m, s);
            v.store(value);
            m.store(mean);
            s.store(square);
            for (int lane = 0; lane < here; ++lane) {
                const int64_t i = from[lane] + column;
                p.value[i] = value[lane];
                p.mean[i] = mean[lane];
                p.square[i] = square[lane];
            }
        }
    }
}

template <class S>
int64_t adam(
    const Parameter<S>& p, float* steps, const S* row_rates, const Rates& rates, int64_t count, int64_t width,
    int threads) {
    const int64_t items = count ? count : width, chunks = (items + kChunk - 1) / kChunk;
    if (!count) {
        const double step = *steps += 1;
        const S rate = S(rates.lr * std::sqrt(1 - std::pow(rates.beta2, step)) / (1 - std::pow(rates.beta1, step)));
        parallel_for(threads, chunks, [&](int64_t chunk) {
            step_values(p, rates, rate, chunk * kChunk, std::min(items, (chunk + 1) * kChunk));
        });
        return 0;
    }
    const Powers power1(rates.beta1), power2(rates.beta2);
    const auto list = width == 1   ? list_rows<1, S>
                      : width == 3 ? list_rows<3, S>
                      : width == 6 ? list_rows<6, S>
                                   : list_rows<0, S>;
    parallel_for(threads, chunks, [&](int64_t chunk) {
        int64_t rows[kChunk + 1];  // the place after the last is written to
        const int64_t begin = chunk * kChunk, end = std::min(items, begin + kChunk);
        const int seen = list(p.gradient, width, begin, end, rows);
        step_rows(p, steps, row_rates, rates, power1, power2, width, rows, seen);
    });
    return 0;
}

}  // namespace

// One step for `count` rows of `width` values, in place; rows whose gradient is zero are left alone, and the others
// count their steps. count = 0: all of `width` values take the step, and `steps` is one number. row_rates may be null.
#define CATACAUSTICS_ADAM(S, SUFFIX)                                                                               \
    CATACAUSTICS_EXPORT int64_t catacaustics_adam_##SUFFIX(                                                        \
        const Run* run, int64_t count, int64_t width, const S* gradient, const S* row_rates, double lr,            \
        double beta1, double beta2, double eps, double weight_decay, float* steps, S* value, S* mean, S* square) { \
        return guarded([&] {                                                                                       \
            return adam<S>(                                                                                        \
                {gradient, value, mean, square}, steps, row_rates, {lr, beta1, beta2, eps, weight_decay}, count,   \
                width, int(run->threads));                                                                         \
        });                                                                                                        \
    }

CATACAUSTICS_ADAM(float, f32)
CATACAUSTICS_ADAM(double, f64)

}  // namespace catacaustics
