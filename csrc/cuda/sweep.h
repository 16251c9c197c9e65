/* SPDX-License-Identifier: Apache-2.0 */
/* The C interface of the plane sweep on a GPU (kernels/reference_motion.py). Plain pointers to the GPU's memory, except
 * `views`, which the host reads; `stream` is a cudaStream_t. No function waits for the GPU or allocates memory. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* colors [h,w,3], missing [h,w], depths [h,w], viewmat [4,4], K [3,3]. */
struct sgs_cuda_sweep_view {
    const float *colors, *missing, *depths, *viewmat, *K;
    float near_plane;
    int width, height;
};
/* pixels [count,2] int64, column and row in view `view_index`, farthest [count]; votes [3,count,planes] zeros, workspace. Out:
 * depths [count], 0 for none; costs [count]. Returns 0, or CUDA's error number. */
int sgs_cuda_sweep(
    const struct sgs_cuda_sweep_view* views, int view_count, int view_index, const int64_t* pixels,
    const float* farthest, int count, int planes, int least_supports, float most_contradictions, float* votes,
    float* depths, float* costs, void* stream);

#ifdef __cplusplus
}
#endif
