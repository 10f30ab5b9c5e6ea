// The neural renderer (catacaustics/renderer.py): two encoders, a decoder and a head, pixel by pixel.
//
// Blocks of pixels pass through all layers while their activations lie in the caches. The backward pass computes a
// block's activations again: that takes less time than storing those of a whole image and reading them back.
// Arrays of a block are (pixels, neurons padded to packs); padding neurons have zero weights.
#include <algorithm>
#include <cstring>
#include <initializer_list>
#include <vector>

#include "guarded.h"
#include "matrix.h"
#include "scratch.h"
#include "threads.h"

namespace catacaustics {
namespace {

constexpr int kDirection = 3, kColour = 3;
enum { kPrimary, kReflection, kDecoder, kMlps };

// Gradients of parameters are summed over groups of at least kGroupBlocks blocks, then over at most kGroups groups:
// these do not depend on the number of threads.
constexpr int64_t kGroupBlocks = 4, kGroups = 32;

// Activations of a layer take three eighths of a first-level cache: those before and behind it fit.
template <class S>
int block_pixels(int width) {
    return std::max(12, std::min(192, 12288 / int(sizeof(S)) / padded<S>(width) / 12 * 12));
}

// scale (W x + b). A layer whose input is two arrays, one behind the other, is a Linear for each.
template <class S>
struct Linear {
    int in, out;
    const S* weight;  // (out, stride), from the first column of this input on
    int64_t stride;
    const S *bias, *scale;             // null: 0, 1
    S *g_weight, *g_bias, *g_scale;    // gradients; null where not wanted
    S *transposed, *rows, *start;      // scaled and padded copies: (in, out), (out, in), (out,)
    int64_t g_rows_place, g_start_place;  // in a list of gradients, padded
};

template <class S>
struct Mlp {
    int inputs;
    std::vector<Linear<S>> layers;  // one for each input, two for each residual block
    Linear<S>* first(int block) { return layers.data() + inputs + 2 * block; }
};

// Memory of a thread for one block of pixels.
template <class S>
struct BlockArrays {
    int rows;
    S *primary, *reflection, *directions;  // inputs
    S *x[kMlps], *hidden[kMlps];           // of each MLP: around its residual blocks, and inside of them
    int64_t step;                          // from one residual block to the next: 0 where each overwrites the last
    S* colour;
    S *g, *g_hidden, *g_code;
};

template <class S>
struct Images {
    S *primary, *reflection, *directions;
};

template <class S>
class Network {
   public:
    // Parameters, and where their gradients go, in the order of NeuralRenderer.parameters().
    Network(int features, int width, int blocks, const S* const* parameters, S* const* gradients);

    void forward(int64_t pixels, const Images<const S>& in, S* image, int threads);
    // Gradients that are null are not wanted.
    void backward(int64_t pixels, const Images<const S>& in, const S* g_image, const Images<S>& g, int threads);

   private:
    template <class F>
    void each_layer(F&& function) {
        for (Mlp<S>& mlp : mlps_) std::for_each(mlp.layers.begin(), mlp.layers.end(), function);
        function(head_);
    }
    BlockArrays<S> arrays(bool keep) const;
    void apply(const Linear<S>& layer, int rows, const S* x, const S* start, S* y, bool relu) const;
    void run(Mlp<S>& mlp, std::initializer_list<const S*> inputs, int rows, S* x, S* hidden, int64_t step);
    void encode_and_decode(int64_t first, const Images<const S>& in, BlockArrays<S>& at);
    void add_gradients(const Linear<S>& layer, int rows, const S* g, const S* x, S* sums) const;
    void back(const Linear<S>& layer, int rows, const S* g, const S* start, S* g_x, const S* where_positive) const;
    void back_through_blocks(int m, BlockArrays<S>& at, S* sums);
    void finish(const Linear<S>& layer, S* sums, int64_t groups) const;
    S* last_x(int m, const BlockArrays<S>& at) const { return at.x[m] + blocks_ * at.step; }

    int features_, width_, blocks_, pixels_;
    bool learns_ = false;
    Mlp<S> mlps_[kMlps];
    Linear<S> head_;
    Scratch<S> copies_;
    int64_t sums_size_ = 0;
};

template <class S>
Network<S>::Network(int features, int width, int blocks, const S* const* parameters, S* const* gradients)
    : features_(features), width_(width), blocks_(blocks), pixels_(block_pixels<S>(width)), learns_(gradients) {
    const auto gradient = [&]() -> S* { return gradients ? *gradients++ : nullptr; };
    const auto add = [&](std::vector<Linear<S>>& layers, std::initializer_list<int> inputs, int out, const S* scale,
                         S* g_scale) {
        const S *weight = *parameters++, *bias = *parameters++;
        S *g_weight = gradient(), *g_bias = gradient();
        int64_t stride = 0, column = 0;
        for (int in : inputs) stride += in;
        for (int in : inputs) {
            layers.push_back({in, out, weight + column, stride, column ? nullptr : bias, scale,
                              g_weight ? g_weight + column : nullptr, column ? nullptr : g_bias, g_scale, nullptr,
                              nullptr, nullptr, 0, 0});
            column += in;
        }
    };
    const std::initializer_list<int> inputs[kMlps] = {{features, kDirection}, {features}, {width, width}};
    for (int m = 0; m < kMlps; ++m) {
        mlps_[m].inputs = int(inputs[m].size());
        add(mlps_[m].layers, inputs[m], width, nullptr, nullptr);
        for (int block = 0; block < blocks; ++block) {
            const S* scale = *parameters++;
            S* g_scale = gradient();
            add(mlps_[m].layers, {width}, width, nullptr, nullptr);
            add(mlps_[m].layers, {width}, width, scale, g_scale);
        }
    }
    std::vector<Linear<S>> head;
    add(head, {width}, kColour, nullptr, nullptr);
    head_ = head[0];

    int64_t size = 0;
    each_layer([&](const Linear<S>& l) { size += (l.in + 1) * padded<S>(l.out) + l.out * padded<S>(l.in); });
    copies_.allocate(size);
    std::memset(copies_.data(), 0, size * sizeof(S));
    S* next = copies_.data();
    each_layer([&](Linear<S>& l) {
        const int in = padded<S>(l.in), out = padded<S>(l.out);
        l.transposed = next;
        l.rows = l.transposed + l.in * out;
        l.start = l.rows + l.out * in;
        next = l.start + out;
        l.g_rows_place = sums_size_;
        l.g_start_place = l.g_rows_place + l.out * in;
        sums_size_ = l.g_start_place + out;
        const S scale = l.scale ? *l.scale : S(1);
        for (int o = 0; o < l.out; ++o) {
            l.start[o] = l.bias ? scale * l.bias[o] : S(0);
            for (int i = 0; i < l.in; ++i)
                l.transposed[i * out + o] = l.rows[o * in + i] = scale * l.weight[o * l.stride + i];
        }
    });
}

template <class S>
BlockArrays<S> Network<S>::arrays(bool keep) const {
    static thread_local Scratch<S> memory;
    static thread_local int64_t room = 0;
    BlockArrays<S> at{};
    for (int pass = 0; pass < 2; ++pass) {
        S* next = pass ? memory.data() : nullptr;
        int64_t used = 0;
        const auto take = [&](S*& array, int neurons, int copies = 1) {
            array = next ? next + used : nullptr;
            used += int64_t(copies) * pixels_ * padded<S>(neurons);
        };
        take(at.primary, features_);
        take(at.reflection, features_);
        take(at.directions, kDirection);
        for (int m = 0; m < kMlps; ++m) {
            take(at.x[m], width_, keep ? blocks_ + 1 : 1);
            take(at.hidden[m], width_, keep ? blocks_ : 1);
        }
        take(at.colour, kColour);
        if (keep) {
            const int widest = std::max(width_, features_);
            take(at.g, widest);
            take(at.g_hidden, widest);
            take(at.g_code, widest);
        }
        if (used > room) {
            room = 0;
            memory.allocate(used);
            room = used;
        }
    }
    at.step = keep ? int64_t(pixels_) * padded<S>(width_) : 0;
    return at;
}

// y = start + W x + b
template <class S>
void Network<S>::apply(const Linear<S>& layer, int rows, const S* x, const S* start, S* y, bool relu) const {
    const int in = padded<S>(layer.in), out = padded<S>(layer.out);
    multiply<S>({rows, layer.in, out, x, in, 1, layer.transposed, out, start, layer.start, y, out, relu, nullptr});
}

// relu(x_n), where x_0 = relu(W x + b), x_{i+1} = x_i + scale (W2 relu(W1 x_i + b1) + b2)
template <class S>
void Network<S>::run(
    Mlp<S>& mlp, std::initializer_list<const S*> inputs, int rows, S* x, S* hidden, int64_t step) {
    int done = 0;
    for (const S* input : inputs) {
        apply(mlp.layers[done], rows, input, done ? x : nullptr, x, done + 1 == mlp.inputs);
        ++done;
    }
    for (int block = 0; block < blocks_; ++block, x += step, hidden += step) {
        const Linear<S>* layer = mlp.first(block);
        apply(layer[0], rows, x, nullptr, hidden, true);
        apply(layer[1], rows, hidden, x, x + step, block + 1 == blocks_);
    }
}

template <class S>
void copy_rows(const S* from, int columns, int rows, S* to) {
    const int line = padded<S>(columns);
    for (int i = 0; i < rows; ++i, from += columns, to += line) {
        for (int k = columns & ~1; k < line; ++k) to[k] = S(0);
        for (int k = 0; k < columns; ++k) to[k] = from[k];
    }
}

template <class S>
void Network<S>::encode_and_decode(int64_t first, const Images<const S>& in, BlockArrays<S>& at) {
    copy_rows(in.primary + first * features_, features_, at.rows, at.primary);
    copy_rows(in.reflection + first * features_, features_, at.rows, at.reflection);
    copy_rows(in.directions + first * kDirection, kDirection, at.rows, at.directions);
    const auto mlp = [&](int m, std::initializer_list<const S*> inputs) {
        run(mlps_[m], inputs, at.rows, at.x[m], at.hidden[m], at.step);
    };
    mlp(kPrimary, {at.primary, at.directions});
    mlp(kReflection, {at.reflection});
    mlp(kDecoder, {last_x(kPrimary, at), last_x(kReflection, at)});
}

template <class S>
void Network<S>::forward(int64_t pixels, const Images<const S>& in, S* image, int threads) {
    parallel_for(threads, (pixels + pixels_ - 1) / pixels_, [&](int64_t block) {
        BlockArrays<S> at = arrays(false);
        const int64_t first = block * pixels_;
        at.rows = int(std::min<int64_t>(pixels_, pixels - first));
        encode_and_decode(first, in, at);
        apply(head_, at.rows, last_x(kDecoder, at), nullptr, at.colour, false);
        for (int i = 0; i < at.rows; ++i)
            for (int c = 0; c < kColour; ++c) {
                const int64_t feature = (first + i) * features_ + c;
                image[(first + i) * kColour + c] =
                    in.primary[feature] + in.reflection[feature] + at.colour[i * padded<S>(kColour) + c];
            }
    });
}

// Adds the gradients of a layer's rows, g^T x, and biases.
template <class S>
void Network<S>::add_gradients(const Linear<S>& layer, int rows, const S* g, const S* x, S* sums) const {
    if (!learns_) return;
    const int in = padded<S>(layer.in), out = padded<S>(layer.out);
    S *g_rows = sums + layer.g_rows_place, *g_start = sums + layer.g_start_place;
    multiply<S>({layer.out, rows, in, g, 1, out, x, in, g_rows, nullptr, g_rows, in});
    const S one(1);
    if (layer.bias) multiply<S>({1, rows, out, &one, 0, 0, g, out, g_start, nullptr, g_start, out});
}

// g_x = start + g W, and 0 where ReLU was 0
template <class S>
void Network<S>::back(
    const Linear<S>& layer, int rows, const S* g, const S* start, S* g_x, const S* where_positive) const {
    const int in = padded<S>(layer.in), out = padded<S>(layer.out);
    multiply<S>({rows, layer.out, in, g, out, 1, layer.rows, in, start, nullptr, g_x, in, false, where_positive});
}

// at.g: from the gradient of relu(x_n)'s argument to that of W x + b.
template <class S>
void Network<S>::back_through_blocks(int m, BlockArrays<S>& at, S* sums) {
    for (int block = blocks_ - 1; block >= 0; --block) {
        const Linear<S>* layer = mlps_[m].first(block);
        const S *x = at.x[m] + block * at.step, *hidden = at.hidden[m] + block * at.step;
        add_gradients(layer[1], at.rows, at.g, hidden, sums);
        back(layer[1], at.rows, at.g, nullptr, at.g_hidden, hidden);
        add_gradients(layer[0], at.rows, at.g_hidden, x, sums);
        back(layer[0], at.rows, at.g_hidden, at.g, at.g, block == 0 ? x : nullptr);
    }
}

// Writes a layer's gradients, summed over groups. With W' = scale W and b' = scale b, as used:
// g_W = scale g_W', g_b = scale g_b', g_scale = g_W' . W + g_b' . b
template <class S>
void Network<S>::finish(const Linear<S>& layer, S* sums, int64_t groups) const {
    const int in = padded<S>(layer.in);
    const int64_t end = layer.g_start_place + padded<S>(layer.out);
    for (int64_t group = 1; group < groups; ++group)
        for (int64_t i = layer.g_rows_place; i < end; ++i) sums[i] += sums[group * sums_size_ + i];
    const S *g_rows = sums + layer.g_rows_place, *g_start = sums + layer.g_start_place;
    const S scale = layer.scale ? *layer.scale : S(1);
    double g_scale = 0;
    for (int o = 0; o < layer.out; ++o) {
        for (int i = 0; i < layer.in; ++i) {
            layer.g_weight[o * layer.stride + i] = scale * g_rows[o * in + i];
            g_scale += double(g_rows[o * in + i]) * double(layer.weight[o * layer.stride + i]);
        }
        if (!layer.bias) continue;
        layer.g_bias[o] = scale * g_start[o];
        g_scale += double(g_start[o]) * double(layer.bias[o]);
    }
    if (layer.scale) *layer.g_scale = S(g_scale);
}

template <class S>
void Network<S>::backward(
    int64_t pixels, const Images<const S>& in, const S* g_image, const Images<S>& g, int threads) {
    const int64_t blocks = (pixels + pixels_ - 1) / pixels_;
    const int64_t groups = std::max<int64_t>(1, std::min(kGroups, blocks / kGroupBlocks));
    Scratch<S> sums(groups * sums_size_);
    parallel_for(threads, groups, [&](int64_t group) {
        S* own = sums.data() + group * sums_size_;
        std::memset(own, 0, sums_size_ * sizeof(S));
        BlockArrays<S> at = arrays(true);
        for (int64_t block = blocks * group / groups; block < blocks * (group + 1) / groups; ++block) {
            const int64_t first = block * pixels_;
            at.rows = int(std::min<int64_t>(pixels_, pixels - first));
            encode_and_decode(first, in, at);

            const S* codes[] = {last_x(kPrimary, at), last_x(kReflection, at), last_x(kDecoder, at)};
            copy_rows(g_image + first * kColour, kColour, at.rows, at.colour);
            add_gradients(head_, at.rows, at.colour, codes[kDecoder], own);
            back(head_, at.rows, at.colour, nullptr, at.g, codes[kDecoder]);
            back_through_blocks(kDecoder, at, own);
            const Linear<S>* layer = mlps_[kDecoder].layers.data();
            add_gradients(layer[0], at.rows, at.g, codes[kPrimary], own);
            add_gradients(layer[1], at.rows, at.g, codes[kReflection], own);
            back(layer[1], at.rows, at.g, nullptr, at.g_code, codes[kReflection]);
            back(layer[0], at.rows, at.g, nullptr, at.g_hidden, codes[kPrimary]);

            // The gradient of an input; colours are added to the image as they are.
            const auto input = [&](const Linear<S>& layer, const S* x, S* g_x) {
                add_gradients(layer, at.rows, at.g, x, own);
                if (!g_x) return;
                back(layer, at.rows, at.g, nullptr, at.g_hidden, nullptr);
                const int line = padded<S>(layer.in);
                for (int i = 0; i < at.rows; ++i)
                    for (int k = 0; k < layer.in; ++k)
                        g_x[(first + i) * layer.in + k] = at.g_hidden[i * line + k];
            };
            const auto add_image = [&](S* g_x) {
                for (int i = 0; g_x && i < at.rows; ++i)
                    for (int c = 0; c < kColour; ++c)
                        g_x[(first + i) * features_ + c] += g_image[(first + i) * kColour + c];
            };
            std::swap(at.g, at.g_hidden);
            back_through_blocks(kPrimary, at, own);
            input(mlps_[kPrimary].layers[0], at.primary, g.primary);
            input(mlps_[kPrimary].layers[1], at.directions, g.directions);
            add_image(g.primary);
            std::swap(at.g, at.g_code);
            back_through_blocks(kReflection, at, own);
            input(mlps_[kReflection].layers[0], at.reflection, g.reflection);
            add_image(g.reflection);
        }
    });
    if (!learns_) return;
    std::vector<const Linear<S>*> layers;
    each_layer([&](const Linear<S>& layer) { layers.push_back(&layer); });
    parallel_for(threads, int64_t(layers.size()), [&](int64_t i) { finish(*layers[i], sums.data(), groups); });
}

}  // namespace

#define CATACAUSTICS_NETWORK(S, SUFFIX)                                                                                \
    CATACAUSTICS_EXPORT int64_t catacaustics_network_##SUFFIX(                                                         \
        const Run* run, int64_t pixels, int64_t features, int64_t width, int64_t blocks, const S* primary,             \
        const S* reflection, const S* directions, const S* const* parameters, S* image) {                              \
        return guarded([&] {                                                                                           \
            Network<S> network(int(features), int(width), int(blocks), parameters, nullptr);                           \
            network.forward(pixels, {primary, reflection, directions}, image, int(run->threads));             \
            return int64_t(0);                                                                                         \
        });                                                                                                            \
    }                                                                                                                  \
    CATACAUSTICS_EXPORT int64_t catacaustics_network_backward_##SUFFIX(                                                \
        const Run* run, int64_t pixels, int64_t features, int64_t width, int64_t blocks, const S* primary,             \
        const S* reflection, const S* directions, const S* const* parameters, const S* g_image, S* g_primary,          \
        S* g_reflection, S* g_directions, S* const* g_parameters) {                                                    \
        return guarded([&] {                                                                                           \
            Network<S> network(int(features), int(width), int(blocks), parameters, g_parameters);                      \
            network.backward(                                                                                          \
                pixels, {primary, reflection, directions}, g_image, {g_primary, g_reflection, g_directions},           \
                int(run->threads));                                                                                    \
            return int64_t(0);                                                                                         \
        });                                                                                                            \
    }

CATACAUSTICS_NETWORK(float, f32)
CATACAUSTICS_NETWORK(double, f64)

}  // namespace catacaustics
