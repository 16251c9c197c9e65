// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "splat.h"

namespace structgstream {

// Fills starts, pairs, slots and pair_slots from the splats. A pair's slot depends only on its splat and tile, so
// gradients are summed in the same order for any number of threads. Throws std::bad_alloc if memory is not sufficient.
void bin(Raster& raster);

}  // namespace structgstream
