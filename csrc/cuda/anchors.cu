// SPDX-License-Identifier: Apache-2.0
// The interface of anchors.h on a GPU.

#include "anchor_calls.h"
