/* SPDX-License-Identifier: Apache-2.0 */
/* Several views without gradients on a GPU, each kernel once for all of them, or one with gradients. Plain pointers to its memory,
 * but for structures, which lie in that of the host; `stream` is a cudaStream_t. All return 0, or CUDA's error number. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Gaussians of a view, as in sgs_raster_forward of structgstream.h. ids [count] int64. Those from colors on may be null. */
struct sgs_cuda_gaussians {
    const float *means, *quats, *scales, *opacities, *colors, *intervals, *screen_offsets;
    const int64_t* ids;
    int64_t count;
};
/* tiles: bytes of those that are drawn, or null; background [3] or null. Out, each or null: image [H,W,3] and alpha [H,W], of which
 * the image stays what it is where nothing is drawn; radii of both sets; sums [., channels] of maps [H,W,channels], at the ids of the
 * first set, which needs all tiles. */
struct sgs_cuda_view {
    struct sgs_cuda_gaussians gaussians, statics;
    const float *viewmat, *K, *background, *maps;
    const uint8_t* tiles;
    float *image, *alpha, *radii, *sums;
    int32_t width, height, channels;
    float near_plane;
};
/* Waits once, for the numbers of pairs. */
int sgs_cuda_views(const struct sgs_cuda_view* views, int count, void* stream);

/* Draws one view, whose image and alpha are not null. Out: raster, what gradients need, to be freed in any case; what the view points
 * to, its image, too, must live as long. Waits once. */
int sgs_cuda_raster_new(const struct sgs_cuda_view* view, void** raster, void* stream);
/* Of both sets of Gaussians, those of the statics zero: means [.,3], quats [.,4], scales [.,3], opacities, colors [.,3] and
 * screen_offsets [.,2], the last one may be null. */
struct sgs_cuda_gradients {
    float *means, *quats, *scales, *opacities, *colors, *screen_offsets;
};
/* image_gradient [H,W,3], alpha_gradient [H,W] or null. All gradients are written, in a fixed order of sums. Waits for nothing. */
int sgs_cuda_raster_backward(
    void* raster, const float* image_gradient, const float* alpha_gradient, const struct sgs_cuda_gradients* gradients,
    void* stream);
void sgs_cuda_raster_free(void* raster);

/* The tiles that Gaussians reach (reference_raster.reached_tiles): K of the picture, reduced_K of the one on which extents are
 * measured, visible: a byte for each id. Out: tiles, a byte each, 1 where one is reached, else what they are. */
struct sgs_cuda_reach {
    struct sgs_cuda_gaussians gaussians;
    const float *viewmat, *K, *reduced_K;
    const uint8_t* visible;
    uint8_t* tiles;
    int32_t width, height, reduced_width, reduced_height;
    float near_plane, margin;
};
/* Waits for nothing. */
int sgs_cuda_reached_tiles(const struct sgs_cuda_reach* views, int count, void* stream);

/* What is displayed of a picture drawn on black (reference_raster.display): image [H,W,3], alpha [H,W], environment
 * [terms,3] with 1, 4 or 9 terms, or null and 0. pixel_to_world [3,3]: a pixel (x, y, 1) times it is a ray. Out:
 * picture [H,W,3]. */
struct sgs_cuda_display_call {
    const float *image, *alpha, *environment;
    uint8_t* picture;
    float pixel_to_world[9];
    int32_t width, height, terms;
};
/* Waits for nothing. */
int sgs_cuda_display(const struct sgs_cuda_display_call* call, void* stream);

#ifdef __cplusplus
}
#endif
