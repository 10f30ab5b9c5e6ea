// The forward pass over tiles, which the backward pass repeats to set checkpoints.
#pragma once

#include "tile.h"

namespace catacaustics {

template <class S>
constexpr int max_channels = sizeof(S) == 4 ? 16 : 4;

// Writes the transmittance in front of every kChunk-th entry of each tile to `checkpoints`, and to `walked` the number
// of entries of each tile after which none is drawn.
template <class S>
void set_checkpoints(
    const Run& run, const Splats<S>& splats, const Window& window, S stop, S* checkpoints, int64_t* walked);

}  // namespace catacaustics
