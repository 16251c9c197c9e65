/* SPDX-License-Identifier: Apache-2.0 */
/* Pictures without gradients on a GPU. Plain pointers to its memory; `stream` is a cudaStream_t. Arguments are those of
 * sgs_raster_forward and sgs_raster_weights in structgstream.h. All return 0, or CUDA's error number. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Out: radii [N]. Waits for nothing. */
int sgs_cuda_radii(
    int64_t count, const float* means, const float* quats, const float* scales, const float* opacities,
    const float* viewmat, const float* K, int width, int height, float near_plane, const float* intervals, float* radii,
    void* stream);
/* Out: image [H,W,3], alpha [H,W] and radii [N], each or null; weights [N,channels] of maps [H,W,channels], if channels is not
 * 0. Waits once, for the number of pairs. */
int sgs_cuda_picture(
    int64_t count, const float* means, const float* quats, const float* scales, const float* opacities,
    const float* colors, const float* viewmat, const float* K, int width, int height, float near_plane,
    const float* background, const float* intervals, const float* maps, int channels, float* weights, float* image,
    float* alpha, float* radii, void* stream);

#ifdef __cplusplus
}
#endif
