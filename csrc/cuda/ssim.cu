// SPDX-License-Identifier: Apache-2.0
// The interface of ssim.h on a GPU.

#include "ssim_calls.h"
