// SPDX-License-Identifier: Apache-2.0
// The interfaces of fit.h, picture.h and ssim.h on a CPU, for tests: blocks, threads and elements one after another, in
// reverse order if `stream` is not null; a warp is a vector, and memory is NaN until it is written.

#include "fit_calls.h"
#include "picture_calls.h"
#include "ssim_calls.h"
