// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "splat.h"

namespace structgstream {

// Fills starts, pairs, slots and pair_slots from the splats. A pair's slot depends on its splat and tile alone, so
// gradients are summed in one order whatever the threads do.
void bin(Raster& raster);

}  // namespace structgstream
