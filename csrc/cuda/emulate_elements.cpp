// SPDX-License-Identifier: Apache-2.0
// The interfaces of anchors.h, lift.h and sweep.h on a CPU, for tests: the elements of a GPU's threads, one after another.
// `stream` is not a stream: elements are computed in reverse order if it is not null.

#include "anchor_calls.h"
#include "lift_calls.h"
#include "sweep_calls.h"
