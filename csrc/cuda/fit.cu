// SPDX-License-Identifier: Apache-2.0
// The interface of fit.h on a GPU.

#include "fit_calls.h"
