// SPDX-License-Identifier: Apache-2.0
// The interfaces of anchors.h, sweep.h and tiles.h on a processor, for tests: the elements that a GPU's threads make, one after
// another. `stream` is not a stream: they are made last first when it is not null.

#include "anchor_calls.h"
#include "sweep_calls.h"
#include "tile_calls.h"
