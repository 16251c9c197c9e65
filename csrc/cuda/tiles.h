/* SPDX-License-Identifier: Apache-2.0 */
/* The C interface of the steps between the sorts of kernels/cuda_tiles.py. Plain pointers to the GPU's memory; `stream` is a
 * cudaStream_t. No function waits for the GPU or allocates memory. All return 0, or CUDA's error number. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* radii [N,2] int32, depths [N]. Out: keys [N], the depth of drawn Gaussians, infinite for others. */
int sgs_cuda_tile_depths(const int32_t* radii, const float* depths, int count, float* keys, void* stream);
/* order [N] int64: Gaussians by depth. Out: pairs [N] int64, tiles of each in that order. */
int sgs_cuda_tile_counts(
    const float* means2d, const int32_t* radii, const int64_t* order, int count, int columns, int rows, int64_t* pairs,
    void* stream);
/* ends [N] int64: running sums of pairs. Out: tiles and ids [capacity] int32, by depth; entries beyond the pairs have
 * tiles of the row below the picture. */
int sgs_cuda_tile_fill(
    const float* means2d, const int32_t* radii, const int64_t* order, const int64_t* ends, int count, int columns,
    int rows, int64_t capacity, int32_t* tiles, int32_t* ids, void* stream);
/* sorted_tiles [capacity] int32 ascending and by_tile [capacity] int64, their indices before sorting. Out: starts
 * [(rows+1)*columns] int32, sorted_ids [capacity] int32. */
int sgs_cuda_tile_starts(
    const int32_t* sorted_tiles, const int64_t* by_tile, const int32_t* ids, int64_t capacity, int columns, int rows,
    int32_t* starts, int32_t* sorted_ids, void* stream);

/* mask: a byte for each tile. Out: drawn [N], the larger radius, pixels; 0 for a Gaussian that is not drawn, or whose box
 * contains pixel centres but none of a tile of the mask. */
int sgs_cuda_tile_reached(
    const float* means2d, const int32_t* radii, int count, const uint8_t* mask, int width, int height, float* drawn,
    void* stream);

#ifdef __cplusplus
}
#endif
