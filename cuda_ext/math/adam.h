// Adam (Kingma and Ba 2015) with decoupled weight decay (see catacaustics/training/optimizer.py).
#pragma once

#include "common.h"

namespace catacaustics {

// What all values of a parameter share.
template <class T>
struct AdamSettings {
    T mean_share, square_share, square_kept;  // 1 - beta1, 1 - beta2, beta2
    T value_kept;                             // 1 - learning rate * weight decay
    T eps;
};

// `rate` is the learning rate with both bias corrections: lr sqrt(1 - beta2^k) / (1 - beta1^k) in step k.
template <class T>
CATACAUSTICS_HD void adam_step(const AdamSettings<T>& settings, T rate, T gradient, T& value, T& mean, T& square) {
    mean = mean + settings.mean_share * (gradient - mean);
    square = settings.square_kept * square + settings.square_share * (gradient * gradient);
    value = settings.value_kept * value - rate * mean / (square_root(square) + settings.eps);
}

}  // namespace catacaustics
