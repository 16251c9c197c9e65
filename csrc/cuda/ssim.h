/* SPDX-License-Identifier: Apache-2.0 */
/* The C interface of the loss on a GPU: plain pointers to the GPU's memory, no torch. Tensors are contiguous, row-major,
 * float32 unless stated otherwise; `stream` is a cudaStream_t. No function waits for the GPU or allocates memory. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* One of target (float) and target_u8 is null. gains and biases [3], applied to the image first, or both null. tiles: a
 * byte for each tile of 16 x 16 pixels, zero where the picture counts as equal, or null. Out: means [2], of the absolute
 * difference and of SSIM; adjoints [3,H,W,3] for backward, or null; sums [2,tiles] is workspace. All return 0, or
 * CUDA's error number. */
int sgs_cuda_l1_ssim(
    const float* image, const float* target, const uint8_t* target_u8, int height, int width, const float* gains,
    const float* biases, const uint8_t* tiles, float* adjoints, float* sums, float* means, void* stream);
/* to_l1 and to_ssim [1]: gradients of the two means. Out: gradient [H,W,3], zero in tiles that do not count. */
int sgs_cuda_l1_ssim_backward(
    const float* image, const float* target, const uint8_t* target_u8, int height, int width, const float* gains,
    const float* biases, const uint8_t* tiles, const float* adjoints, const float* to_l1, const float* to_ssim,
    float* gradient, void* stream);
/* The meaning of an error number. */
const char* sgs_cuda_error(int error);
/* 1 if the driver runs the CUDA version that this library was compiled with, else 0. Needs no GPU. */
int sgs_cuda_driver_fits(void);

#ifdef __cplusplus
}
#endif
