// SPDX-License-Identifier: Apache-2.0
// The block of pixels of a vector.
#pragma once

#include "splat.h"
#include "vec.h"

namespace structgstream {
namespace SGS_ISA {

constexpr int kBlockX = kLanes == 4 ? 2 : 4;
constexpr int kBlockY = kLanes / kBlockX;
constexpr int kBlocksX = kTile / kBlockX;
constexpr int kBlocksY = kTile / kBlockY;
constexpr int kBlocks = kBlocksX * kBlocksY;

}  // namespace SGS_ISA
}  // namespace structgstream
