// SPDX-License-Identifier: Apache-2.0
// The interface of tiles.h on a GPU.

#include "tile_calls.h"
