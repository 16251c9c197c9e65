// SPDX-License-Identifier: Apache-2.0
// The interface of lift.h on a GPU.

#include "lift_calls.h"
