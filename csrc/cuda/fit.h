/* SPDX-License-Identifier: Apache-2.0 */
/* The iterations of a later frame on a GPU, without Python between them. `frame` is described in structgstream.h; there
 * leaves, pictures, weights and all that belongs to a view lie in the GPU's memory, but the array of views, order, rests, rates
 * and the results in the host's. `stream` is a cudaStream_t. All return 0, or CUDA's error number. */
#pragma once

#include <stdint.h>

#include "../include/structgstream.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Out: fit, to be freed in any case. The frame is copied, what it points to must live as long. slots: places for gradients of
 * pairs of a Gaussian and a tile; more are made when they are needed. Waits once. */
int sgs_cuda_fit_new(const struct sgs_fit_frame* frame, int64_t slots, void* stream, void** fit);
/* Iterations from ... to - 1, and their results; waits once, and once more whenever there were too few slots. */
int sgs_cuda_fit_run(void* fit, int from, int to);
void sgs_cuda_fit_free(void* fit);

#ifdef __cplusplus
}
#endif
