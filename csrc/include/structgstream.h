/* SPDX-License-Identifier: Apache-2.0 */
/* The C interface of the CPU kernels: plain pointers, no torch. Tensors are contiguous, row-major, float32 unless stated
 * otherwise. `threads` is the number of threads that a call may use; results do not depend on it. */
#pragma once

#include <stdint.h>

#include "../cpu/anchors.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Version of the library's interface. It is incremented with every change of the declarations in this file or in
 * cpu/anchors.h. kernels/native.py requires the same number, so that a library of another version is refused. */
#define SGS_ABI_VERSION 11
int sgs_abi_version(void);

/* Instruction sets: 0 baseline (SSE2, NEON or plain C++), 1 AVX2 with FMA, 2 AVX-512. */
int sgs_isa(void);           /* the one in use */
int sgs_best_isa(void);      /* the widest that was compiled and that this processor has */
int sgs_use_isa(int isa);    /* switch, for tests; returns the one in use afterwards */

/* Rasteriser. Forward returns a state for backward, null if memory is not sufficient; sgs_raster_free releases it.
 * means [N,3], quats [N,4] wxyz, scales [N,3], opacities [N], colors [N,3], viewmat [4,4] world to camera, K [3,3] pixels;
 * background [3] or null, screen_offsets [N,2] or null; intervals [N], the size of a training pixel at each Gaussian, or null
 * (reference_raster.screen_low_pass). drawn_tiles: one byte for each tile of 16 x 16 pixels, row by row, zero where nothing
 * is drawn and the picture does not change; or null. Gaussians from `trained` on get no gradient.
 * Out: image [H,W,3], alpha [H,W], radii [N]. */
void* sgs_raster_forward(
    int64_t count, const float* means, const float* quats, const float* scales, const float* opacities,
    const float* colors, const float* viewmat, const float* K, int width, int height, float near_plane,
    const float* background, const float* screen_offsets, const float* intervals, const uint8_t* drawn_tiles,
    int64_t trained, float* image, float* alpha, float* radii, int threads);
/* Out: radii [N] alone. Returns 0, or 1 if memory is not sufficient. */
int sgs_raster_radii(
    int64_t count, const float* means, const float* quats, const float* scales, const float* opacities,
    const float* viewmat, const float* K, int width, int height, float near_plane, const float* intervals, float* radii,
    int threads);
/* weights [N,C]: for each Gaussian the sum over the pixels of its blending weight times each of maps [H,W,C], C =
 * channels >= 1. Needs C numbers of memory for each pair of a Gaussian and a tile. image [H,W,3]: the picture of colors
 * [N,3] over background [3] or null, drawn in the same pass; or null together with colors. Returns 0, or 1 if memory is
 * not sufficient. */
int sgs_raster_weights(
    int64_t count, const float* means, const float* quats, const float* scales, const float* opacities,
    const float* colors, const float* viewmat, const float* K, int width, int height, float near_plane,
    const float* background, const float* intervals, const float* maps, int channels, float* weights, float* image,
    int threads);
/* grad_image [H,W,3]; grad_alpha [H,W] or null. Returns 0, or 1 if memory is not sufficient. */
int sgs_raster_backward(
    const void* state, int64_t count, const float* means, const float* quats, const float* scales,
    const float* opacities, const float* colors, const float* background, const float* image, const float* alpha,
    const float* grad_image, const float* grad_alpha, float* grad_means, float* grad_quats, float* grad_scales,
    float* grad_opacities, float* grad_colors, float* grad_screen_offsets, int threads);
void sgs_raster_free(void* state);

/* Loss. One of target (float) and target_u8 is null. gains and biases [3], applied to the image first, or both null.
 * tiles: a byte for each tile of 16 x 16 pixels, zero where the picture does not count (the image is read up to ten
 * pixels around the others), or null. Out: row sums [H]; gradient [H,W,3] of SSIM, written where it counts, or null. */
void sgs_l1_ssim(
    const float* image, const float* target, const uint8_t* target_u8, int height, int width, const float* gains,
    const float* biases, const uint8_t* tiles, float* gradient, double* row_l1, double* row_ssim, int threads);
void sgs_l1_ssim_backward(
    const float* image, const float* target, const uint8_t* target_u8, int height, int width, const float* gains,
    const float* biases, const uint8_t* tiles, const float* ssim_gradient, float l1_scale, float ssim_scale,
    float* gradient, int threads);

/* Pixels whose 3 x 3 mean absolute difference (of pictures [H,W,3]) exceeds `threshold` (in 0 ... 1), and those up to
 * `reach` pixels from them: one byte each. Returns 0, or 1 if memory is not sufficient. */
int sgs_changed_pixels(
    const uint8_t* before, const uint8_t* now, int height, int width, float threshold, int reach, uint8_t* changed,
    int threads);

/* A rendering [height,width,3] and its comparison (kernels/reference_motion.py): picture u8 [reduced_height,
 * reduced_width, 3]; gains and biases [3] or null; tiles, a byte each, and outside u8 [height,width,3], which is shown in those
 * that are zero, or both null; mask, a byte for each pixel of the picture, or null. */
struct sgs_residual {
    const float *rendering, *gains, *biases;
    const uint8_t *picture, *tiles, *outside, *mask;
    int height, width, reduced_height, reduced_width;
};
/* Out: found [reduced_height, reduced_width]. Returns 0, or 1 if memory is not sufficient. */
int sgs_picture_residual(const struct sgs_residual* residual, float* found);

/* Forward-backward consistent flow (kernels/reference_motion.py). flow and back [H,W,2], mask [H,W] one byte each or
 * null. Out: maps [3,H,W]. */
void sgs_confident_flow(
    const float* flow, const float* back, const uint8_t* mask, int height, int width, float relative, float absolute,
    float* maps, int threads);

/* Flow in pictures lifted to displacements (kernels/reference_motion.py). centers [E,3], weights [V,E], flows [V,E,2],
 * viewmats [V,4,4], Ks [V,3,3], near_planes [V], neighbours [T,N] rows of movers, affinities [T,N], priors [T,3]. Out:
 * displacements [T,3], inlier_share [T], agreeing_views [T]. Returns 0, or 1 if memory is not sufficient. */
int sgs_lift_flow(
    const float* centers, const float* weights, const float* flows, const float* viewmats, const float* Ks,
    const float* near_planes, const int64_t* neighbours, const float* affinities, const float* priors, int64_t movers,
    int64_t targets, int views, int neighbour_count, float share, float* displacements, float* inlier_share,
    int64_t* agreeing_views, int threads);

/* A view of the plane sweep (kernels/reference_motion.py). colors [h,w,3], missing [h,w], depths [h,w]. */
struct sgs_sweep_view {
    const float *colors, *missing, *depths;
    float viewmat[12], K[9], near_plane;
    int width, height;
};
/* pixels [count,2] column and row in view `view_index`, farthest [count]. Out: depths [count], 0 for none; costs [count]. */
void sgs_sweep(
    const struct sgs_sweep_view* views, int view_count, int view_index, const int64_t* pixels, const float* farthest,
    int64_t count, int planes, int least_supports, float most_contradictions, float* depths, float* costs, int threads);

/* A grey neighbour picture [h,w] (kernels/reference_motion.py). */
struct sgs_neighbour {
    const float* picture;
    int width, height;
};
/* Correlation of neighbours with picture [H,W] through planes: homographies double [planes, neighbours, 3, 3] from its pixels to
 * theirs, window odd, noise added to variances. Out: scores [planes, H, W]. Returns 0, or 1 if memory is not sufficient. */
int sgs_plane_scores(
    const float* picture, int height, int width, const struct sgs_neighbour* neighbours, int neighbour_count,
    const double* homographies, int64_t planes, int window, float noise, float* scores);

/* Anchors (of `count`) that may have a Gaussian in the picture, or in its tiles that are not zero; ascending. Reads
 * positions, scales and offsets; intervals [count] widens the Gaussians by their low-pass, or null. Returns their number,
 * or -1 if memory is not sufficient. */
int64_t sgs_anchors_visible(
    const struct sgs_anchors* anchors, int64_t count, const float* intervals, const float* viewmat, const float* K, int width,
    int height, float near_plane, const uint8_t* tiles, int64_t* visible, int threads);

/* Structured Gaussians: select decodes opacities, dress decodes attributes into arrays of selection->gaussian_count rows. */
void sgs_anchors_select(const struct sgs_anchors* anchors, struct sgs_selection* selection, int threads);
void sgs_anchors_dress(
    const struct sgs_anchors* anchors, const struct sgs_selection* selection, const struct sgs_gaussians* out,
    int threads);
void sgs_anchors_backward(
    const struct sgs_anchors* anchors, const struct sgs_selection* selection, const struct sgs_gaussians* drawn,
    const struct sgs_gaussian_gradients* from, const struct sgs_anchor_gradients* to, int threads);

/* Sum of the products of three scales [N,3], returned, and the number of opacities [N] above zero; gradient [N,3] of
 * `scale` times the sum. */
double sgs_volume(const float* scales, const float* opacities, int64_t count, int64_t* drawn);
void sgs_volume_backward(const float* scales, int64_t count, float scale, float* gradient);

/* Returns the sum of the excess of |offsets [M,each,3] * scales [M,3]| over `limit`. Gradients are those of `factor` times
 * the sum with respect to the offsets and to the logarithms of the scales. */
double sgs_excess(const float* offsets, const float* scales, int64_t anchors, int64_t each, float limit);
void sgs_excess_backward(
    const float* offsets, const float* scales, int64_t anchors, int64_t each, float limit, float factor,
    float* offset_gradient, float* log_scale_gradient);

/* Sum over pairs of shares [M,each] * (sqrt(|values[j] - values[i]|^2 + slack^2) - slack), where row i of `neighbours`
 * [M,each] contains each j; returned. Its gradient with respect to `values` [M,3] is added to `gradient`. */
double sgs_neighbour_difference(
    const float* values, const int64_t* neighbours, const float* shares, int64_t count, int64_t each, float slack,
    float* gradient);

/* Sum of log2(1 + |values - before| / step) over `count` numbers, returned, and its gradient with respect to the values. */
double sgs_change_bits(const float* values, const float* before, int64_t count, float step, float* gradient);

/* Adam, in place, on tensors of `count` numbers. */
void sgs_adam_step(
    float* param, const float* grad, float* first, float* second, int64_t count, double lr, int64_t step, double beta1,
    double beta2, double eps, int threads);

/* Iterations of a later frame in which only anchors and free Gaussians are trained (training/online/iterations.py).
 *
 * A tensor of `count` numbers. values, the moments of Adam, and the sums (null: no mean) are updated in place; all but values
 * are null if it is not trained. step: quantization step, 0 for none. before [before_count]: values from which the rate
 * term counts changes of the first numbers, or null. */
struct sgs_leaf {
    float *values, *first, *second, *sums;
    const float* before;
    int64_t count, before_count;
    float step;
};
/* anchors' positions, offset scales, base scales, offsets, features, appearance; free Gaussians' means, scales, quaternions,
 * opacities, colors: logarithms and logits where the scene has them */
#define SGS_LEAVES 11
/* A picture [H,W,3] to fit. tiles, changed: bytes of the tiles of a full and of a resting visit. mask: a byte for each pixel that
 * counts, or null. background [3] or null. image [H,W,3] is drawn into. Last the static Gaussians; intervals may be null. */
struct sgs_fit_view {
    const float *viewmat, *K, *center;
    const uint8_t *picture, *tiles, *changed, *mask;
    const float *gains, *biases, *background;
    float* image;
    const float *means, *quats, *scales, *opacities, *colors, *intervals;
    int64_t static_count;
    float near_plane;
    int32_t width, height;
};
/* M = anchors, F = free. basis [R,D] or null. anchor_intervals [M] and free_intervals [F] or null. neighbours, shares [M,N] and
 * start [M,3] of the smoothness (N: 0 for none). Iteration i, from 0, visits view order[i], without its tiles at rest if
 * rests[i], and steps by rates [i, SGS_LEAVES]; sums are from mean_from on, squared errors from errors_from.
 * Out: terms [i, 5]: L1, 1 - SSIM, volume, smoothness, total; squared_errors [i]. */
struct sgs_fit_frame {
    struct sgs_leaf leaves[SGS_LEAVES];
    struct sgs_head heads[3];
    const float *basis, *anchor_intervals, *free_intervals;
    const struct sgs_fit_view* views;
    const int64_t* neighbours;
    const float *shares, *start;
    const int32_t* order;
    const uint8_t* rests;
    const double* rates;
    float* terms;
    double* squared_errors;
    int64_t anchors, free, neighbour_count;
    int32_t view_count, offsets_per_anchor, feature_size, hidden_size, distance_input, rank, mean_volume, mean_from,
        errors_from;
    float l1, ssim, volume, smoothness, rate, pixel, slack;
    double beta1, beta2, eps;
};
/* The frame is copied, what it points to must live as long. new and run return null and 1 if memory is not sufficient. run does
 * iterations from ... to - 1. */
void* sgs_fit_new(const struct sgs_fit_frame* frame);
int sgs_fit_run(void* fit, int from, int to, int threads);
void sgs_fit_free(void* fit);

/* Interleaved rANS (docs/entropy.md). symbols [count], contexts [count] rows of frequencies [context_count, alphabet];
 * lanes is 1, 4 or 32; states [lanes]; words has room for `count` (encode). Return 0; 1 if memory is not sufficient;
 * 2 if states and words contradict each other (decode); 3 if symbols, contexts or frequencies are invalid. */
int sgs_rans_encode(
    const uint8_t* symbols, const uint16_t* contexts, int64_t count, const uint16_t* frequencies, int64_t context_count,
    int alphabet, int lanes, uint32_t* states, uint16_t* words, int64_t* word_count);
int sgs_rans_decode(
    const uint16_t* words, int64_t word_count, const uint32_t* states, int lanes, const uint16_t* contexts,
    int64_t count, const uint16_t* frequencies, int64_t context_count, int alphabet, uint8_t* symbols);

/* Adaptive decisions (docs/entropy.md). The bytes of a field during writing or reading: `size` is their number for reading,
 * the capacity for writing; all other members are 0 at first. A model has `inputs` cells for each decision: the
 * probabilities and counts of input k start at row starts[k] + context, `nodes` in a row; weights [nodes, inputs]. */
typedef struct {
    uint8_t* bytes;
    int64_t size, place;
    uint32_t low, range;
    int32_t started;
} sgs_arithmetic;
typedef struct {
    uint16_t* chances;
    uint8_t* seen;
    int32_t* weights;
    const int32_t* starts;
    int32_t inputs, nodes;
} sgs_model;

/* Encode (encodes: 1) or decode (0) in place. Contexts are not checked; the capacity for writing must be sufficient. Return
 * 0; 1 if memory is not sufficient; 2 if a number is out of bounds; 3 if the model is invalid.
 * Activity: history u8 [count], sizes [count] of the last residuals, active u8 [count].
 * Residuals of active rows [count, columns], their last ones, and others [count], the sizes in groups before.
 * Numbers [count], or flags with a model of one node; contexts [count, inputs]. */
int sgs_code_activity(
    sgs_arithmetic* arithmetic, const sgs_model* blocks, const sgs_model* rows, int encodes, int64_t count,
    const uint8_t* history, const int32_t* sizes, uint8_t* active);
int sgs_code_residuals(
    sgs_arithmetic* arithmetic, const sgs_model* model, int encodes, int64_t count, int columns, const int32_t* last,
    const int32_t* others, int32_t* residuals);
int sgs_code_numbers(
    sgs_arithmetic* arithmetic, const sgs_model* model, int encodes, int64_t count, const int32_t* contexts, int flags,
    int64_t* values);

#ifdef __cplusplus
}
#endif
