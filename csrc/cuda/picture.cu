// SPDX-License-Identifier: Apache-2.0
// The interface of picture.h on a GPU.

#include "picture_calls.h"
