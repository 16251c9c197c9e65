// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "splat.h"

namespace structgstream {

// Fills starts, pairs and slots from the splats. Throws std::bad_alloc if memory is not sufficient.
void bin(Raster& raster);

}  // namespace structgstream
