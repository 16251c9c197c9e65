// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "splat.h"

namespace structgstream {

// Fills starts, pairs, slots and pair_slots from the splats. A pair's slot depends on its splat and tile alone, so
// gradients are summed in one order whatever the threads do. Throws std::bad_alloc where they do not fit in memory.
void bin(Raster& raster);

}  // namespace structgstream
