// SPDX-License-Identifier: Apache-2.0
// The interface of sweep.h on a GPU.

#include "sweep_calls.h"
