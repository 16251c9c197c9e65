// SPDX-License-Identifier: Apache-2.0
// Kernels for the instruction set in use, for the other sources.
#pragma once

#include "splat.h"

namespace structgstream {

// Sets the camera and the tiles that are drawn (a byte each; null: all).
void look(
    Raster& raster, const float* viewmat, const float* K, int width, int height, float near_plane,
    const uint8_t* drawn_tiles);
void project(const GaussianInputs& in, Raster& raster, float* radii, int threads);
void rasterize(const Raster& raster, const float* background, float* image, float* alpha, int threads);
void rasterize_backward(
    const Raster& raster, const float* background, const float* image, const float* alpha, const float* grad_image,
    const float* grad_alpha, float* moments, int threads);
void project_backward(
    const GaussianInputs& in, const Raster& raster, const float* moments, const GaussianGradients& out, int threads);

// features [M, D] plus appearance [M, R] times basis [R, D]; from its gradient [M, D] that of the appearance.
void fold_appearance(
    const float* features, const float* appearance, const float* basis, int64_t count, int size, int rank,
    float* folded);
void fold_appearance_backward(
    const float* to_folded, const float* basis, int64_t count, int size, int rank, float* gradient);

}  // namespace structgstream
