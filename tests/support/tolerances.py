"""All numeric tolerances of the tests: one row per quantity, with the reason for its size.

A test calls `assert_close(got, want, "rotation")` or `tolerance("rgb.float32")` and contains no number of its own.
"""

from typing import NamedTuple

import numpy as np


class Row(NamedTuple):
    """`value` is an absolute bound unless the name ends in `.relative`, or in `_db`, which is a lower bound."""

    name: str
    value: float
    reason: str


TABLE = (
    # scene vocabulary, float64
    Row("rotation", 1e-12, "a few dozen float64 operations on numbers of size 1"),
    Row("sh_basis", 1e-12, "polynomials of degree 3 in float64; published constants carry 16 digits"),
    Row("sh_basis.gsplat", 1e-12, "as sh_basis; gsplat keeps some constants to 14 digits"),
    Row("float32.relative", 1e-6, "a handful of float32 operations"),
    Row("pixel", 1e-9, "projecting a known point through float64 matrices, in pixels"),
    Row("placed", 1e-9, "coordinates of 5e6 around a scene of size 1 keep 9 digits of it in float64"),
    Row("pixel.placed", 1e-6, "as placed, times focal lengths of 60 pixels"),
    Row("normalized.scale", 6e-3, "scales and offsets are rounded to three digits"),
    Row("normalized.center", 2e-2, "as normalized.scale, for distances of 4"),
    Row("placed_splat_db", 60.0, "float32 after another scale and offset, rounded 1e-7 of the extent: 1e-5 of a pixel"),
    Row("placed_run_db", 0.5, "scales rounded to three digits move initial Gaussians by up to half a per cent"),
    # 16 numbers at once
    Row("vectors.float32", 3e-5, "some roundings of numbers and sums up to 100; NumPy rounds products first"),
    Row("vectors.float64", 2e-14, "as in float32"),
    Row("exp2.float32", 4e-7, "the polynomial's own 2e-7, and some roundings of float32"),
    Row("exp2.float64", 2e-15, "some roundings of float64"),
    Row("log2.float32", 8e-6, "a rounding of 100"),
    Row("log2.float64", 3e-14, "a rounding of 100, and a series of 11 terms"),
    # rasterizer against the float64 oracle, pixels where no decision is in doubt; colors are of size 1
    Row("rgb.float32", 5e-6, "hundreds of blended splats, each alpha off by a few 1e-6 from the rounding of sigma"),
    Row("alpha.float32", 5e-6, "as rgb"),
    Row("depth.float32.relative", 3e-5, "a quotient of two such sums, both small at the transparent edge of a splat"),
    Row("rgb.float32_8192", 5e-4, "a mean near pixel 8192 is rounded to 2e-4 px in float32; slopes are up to 1 / px"),
    Row("alpha.float32_8192", 5e-4, "as rgb"),
    Row("depth.float32_8192.relative", 3e-5, "as in smaller images: a splat's depth doesn't depend on its place"),
    Row("rgb.float64", 1e-10, "the same in float64, sigma of needles loses six digits"),
    Row("alpha.float64", 1e-10, "as rgb"),
    Row("depth.float64.relative", 1e-10, "as rgb"),
    # projected splats against gsplat's reference, run in float64
    Row("projection.float32.relative", 1e-6, "stored as float32 after float64 arithmetic; relative to the image"),
    Row("projection.float64.relative", 1e-12, "the same formulas, a few dozen roundings"),
    Row("conic.float32.relative", 3e-6, "products of two entries of a root that is stored as float32"),
    Row("conic.float64.relative", 1e-9, "gsplat's determinant, a difference of products, loses 7 digits for needles"),
    Row("projection.gsplat_fisheye", 1e-5, "pixels; gsplat adds 1e-7 to the distance from the axis"),
    Row("conic.finite_differences", 1e-7, "central differences with a step of 1e-6: 1e-13 / 1e-6"),
    Row("color.float32", 2e-6, "16 products of size 1, stored as float32"),
    Row("color.float64", 1e-12, "the same in float64"),
    # SC-GS's own modules, run in float64
    Row("scgs.pose", 1e-4, "float32 of a network of eight layers and of sums of size 10"),
    Row("scgs.losses.relative", 1e-3, "five steps amplify roundings of float64; fitted rotations are sums of products"),
    Row("scgs.exact", 1e-6, "float64, from quaternions of size 1 that were normalized in float32"),
    Row("scgs.rendered", 1e-4, "poses that are 1e-6 off, rounded differently by onnxruntime; colors of size 1"),
    Row("scgs.fitted", 1e-3, "as scgs.losses: Adam divides by gradients, however small"),
    # gradients, relative to the largest entry of their kind
    Row("gradient.finite_differences", 1e-6, "central differences, step 1e-6: 1e-10 / 1e-3 of the largest entry"),
    Row("gradient.autograd", 1e-9, "the same derivative in another order of operations, float64"),
    Row("gradient.float32", 1e-4, "sums over thousands of pixels of terms of both signs, each off by some 1e-6"),
    Row(
        "refined_pose", 1e-6, "the rotation is off by the third power of its angle, 4e-3, over 12, times slopes of 100"
    ),
    Row("gradient.second_order", 1e-5, "what a linear step of 2e-4 leaves out: its square times curvatures up to 100"),
    Row("oracle_db", 70.0, "whole image, threshold pixels included: one step in 1 of 5,000 at every pixel"),
    Row("motion_vector", 2e-3, "pixels; a displacement of 30, stored and blended in float32, over a sum of weights"),
    Row("stress.growth", 61.0, "MiB that 16 threads keep; a frame lost each time would be gigabytes"),
    Row("capture.turn", 0.5, "degrees between neighbours: two of the 224 pixels that show some 50 degrees"),
    Row("kernel_coverage", 95.0, "per cent of the kernels' lines; what is left needs the compiler"),
    Row("cuda.pixel", 1e-3, "7e-4 where a splat's alpha is at the threshold in one of them; 3e-7 in the mean"),
    Row("cuda.psnr", 3.0, "dB; the same images in the same order, but no two runs of a few steps are alike"),
    Row(
        "torch_operations.float64",
        1e-11,
        "as the kernels in another order, relative to the largest; SSIM loses 3 digits",
    ),
    Row("torch_operations.float32", 2e-5, "as in float64; a position in cells is rounded at 1e-5 of a cell"),
    Row("bf16.values", 5e-2, "of the norm; a dozen roundings of 4e-3 in a trunk of three layers"),
    Row("bf16.gradients", 0.2, "of the norm; the same flip units, and an octave of 512 amplifies them in positions"),
    Row("cuda.gradient", 1e-3, "of the largest of its kind; 4e-4 for the same reason"),
    # losses
    Row("ssim.float32", 1e-5, "variances are differences of blurred squares; torch blurs in another order"),
    Row("ssim.float64", 1e-12, "as ssim.float32"),
    Row("psnr.relative", 1e-6, "torchmetrics adds in float32"),
    Row("flip.relative", 1e-5, "the same program; the last bits of its input may differ"),
    Row("loss_gradient", 1e-7, "central differences with steps of 1e-7 and 1e-6 of a loss of size 1"),
    # the deformation network
    Row("skinning_gradient", 2e-7, "central differences with a step of 1e-6: 1e-13 / 1e-6; relative if above 1"),
    Row("first_order", 1e-4, "of errors of 1e-6; their displacement is not quite linear"),
    Row("encoding.float64", 1e-12, "sines of phases up to 1024, each rounded once"),
    Row("encoding.float32", 1e-5, "phases are exact products; what is left is the sine's own rounding"),
    Row("network.float64", 1e-11, "matrix products in another order, five deep, through frequencies up to 512"),
    Row("share.relative", 1e-9, "alternating float64 sums, the terms up to 500 times the result"),
    Row("shared_scale.relative", 3e-6, "a float32 logarithm of size 5, shifted and rounded, back through exp"),
    Row("neighbor_distances", 1e-6, "differences of float32 coordinates of size 5"),
    Row("export.relative", 3e-5, "float32 through frequencies of 512, step after step; export itself allows 1e-4"),
    Row("redrawn", 0.1, "dB; a frame is drawn in float32, and again by gsplat's reference in float64"),
    Row("stored_scale", 1e-5, "logarithms up to 18, and the exponential, in float32"),
    Row("stored_16bit", 1e-3, "half a step of a range of 3 is 2e-5; a network without high frequencies multiplies it"),
    Row("stored_8bit", 5e-2, "half a step of a range of 3 is 6e-3; multiplied as 16 bits are"),
    Row("hutchinson.relative", 0.2, "2,000 random signs: a deviation of 0.03 of each entry, and some clamped pixels"),
    Row("visible_error.relative", 0.1, "means over 257 times, not 1,025, of motion up to the Nyquist rate of either"),
    Row("compact.predicted", 7.0, "dB; errors are taken as independent; those of 12 nodes' followers aren't"),
    Row("compact.pose", 5e-3, "scene units of motion of size 1; what is left of 90 dB in hardly visible Gaussians"),
    Row("fast_motion", 0.05, "scene units of a motion of 1; 513 samples are 8 a period of the fastest one tested"),
    Row("spline_fit", 1e-9, "a pseudo-inverse of a well-conditioned band of up to 129 rows, float64"),
    Row("browser_camera", 1e-5, "entries of a pose near 4; through orbit controls and messages of a page in float32"),
    Row("served_frame", 1e-3, "of a float pixel; onnxruntime's exponentials and products are not torch's to the bit"),
    Row("drawn_here_db", 40.0, "WebGL2 blends splat after splat in 10 bits, of twice the range, against float32"),
    Row("served_frame.8bit", 0.756, "of 255; as served_frame, and half a step of 8 bits"),
    Row(
        "frames.other_processor",
        60.0,
        "dB, at least; splats at a threshold of alpha are drawn on one kind of processor only",
    ),
    Row("read_pose", 1e-6, "of values of size 1: the same graph in float32, by two builds of onnxruntime"),
    # stability: made cases, docs/stability.md
    Row("stability.accepted_db", 50.0, "the export's default bound, which accepted models must keep"),
    Row("stability.predicted", 2.0, "a first-order bound of errors measured once; roundings of the sum come on top"),
    Row("stability.none", 0.0, "a count of pixels that must be 0"),
    Row("stability.first_order", 1e-4, "scene units of round-off up to which a chain is taken as linear; no error"),
    Row("stability.jacobian", 1e-6, "central differences with a step of 1e-7: 1e-13 / 1e-7 through three layers"),
    Row("export.float32_db", 90.0, "worst frame, float32 against float64: at a few pixels a splat is at its cut-off"),
    Row("pruning.other_times_db", 2.0, "a quarter more error at times other than the selection times of pruning"),
    # files of other programs
    Row("splat_values", 3e-6, "float32 logarithms and logits of size 10, back through exp"),
    Row("splat_file_db", 60.0, "stored as float32: lossless"),
    Row("quantised_splat_file_db", 45.0, "bytes of color and opacity, 8 to 16 bits of everything else: lossy"),
    Row("stored_frame", 1e-4, "16 bits over a motion of half the scene, relative to the scene"),
    Row(
        "half_float",
        1e-3,
        "values up to 2: half of the last of 11 bits, and toHalfFloat of three.js, which cuts it off",
    ),
    Row("spz_position", 3e-4, "scene units; 12 fractional bits"),
    Row("spz_rotation", 2e-2, "entries of a matrix; 10 bits a component of one file, 10 of the other"),
    Row("damaged_file.seconds", 20.0, "of the processor; small files take milliseconds; some code is compiled, too"),
    Row("damaged_file.megabytes", 8.0, "beside twice the sound file's: what the allocator keeps from call to call"),
    Row("import.network", 1e-5, "a network of 8 layers in float32, its sums in another order"),
    Row("agreement.forward", 1e-4, "another program's network in float32; numbers of size 1"),
    Row(
        "agreement.training",
        1e-3,
        "as forward after five steps of Adam, which divides by small gradients; relative too",
    ),
    Row("visionary.relative", 2e-5, "products of float32 rotations and scales, relative to the largest covariance"),
    Row("visionary.sh", 2e-3, "float16 of coefficients up to 3"),
    # datasets
    Row("rounded_to_8bit", 0.501, "half a step of 8 bits, and the float32 sums before it"),
    Row("composite_of_8bit", 1.001 / 255, "half a step of color and half a step of alpha, each rounded once"),
    Row("video_color", 4.0, "of 255, even colors: YCbCr has 219 steps for 255, and is rounded on both ways"),
    Row("video_edge.mean", 8.0, "of 255, an edge of a gray ramp: the codecs' quantization, on few pixels"),
    Row("video_image.mean", 1.0, "of 255, waves: as video_color, on average; FFmpeg's fast way is 1.4 to 2 off"),
    Row("ray_hit", 1e-3, "scene units; a ray stops 2e-4 before a surface, earlier in a bent one or along a wall"),
    Row("material_point", 1e-6, "scene units; trajectories are written with 7 digits"),
    Row("image_offset", 0.1, "pixels; estimated from colors at 96×96, where half a pixel would be a wrong centre"),
    Row("dot_centroid", 0.05, "pixels; a dot of 2 pixels in 8 bits, stretched unevenly over its width by the lens"),
    Row("silent_places", 0.02, "part of the places where a new layer can't learn; 0.4 % for the smallest one tested"),
    # the paper's tables
    Row("published.psnr", 1e-2, "means are published with two decimals, some rounded down"),
    Row("published.ssim_lpips", 1e-3, "means are published with three decimals, some rounded down, one up"),
    Row("published.rate.relative", 1e-5, "last values of rates in published.toml have six digits"),
    Row("published.rate", 1e-12, "the same formula in float64"),
    Row("volume.pixel", 1e-4, "pixels; directions of size 1 in float32, times a focal length of 33"),
    Row("volume.forward", 1e-6, "colors of size 1; published volumes add 1e-10 to what is left behind each sample"),
    Row("volume.trained", 1e-6, "tensors of size 1, float64; as volume.forward, after five steps of Adam"),
)

_ROWS = {row.name: row for row in TABLE}
assert len(_ROWS) == len(TABLE), "a quantity has two rows"


def tolerance(name: str) -> float:
    """The bound of one row of the table."""
    return _ROWS[name].value


def assert_close(got: object, want: object, name: str) -> None:
    """Shapes agree and no element is further off than the row allows."""
    got, want = np.asarray(got), np.asarray(want)
    assert got.shape == want.shape, f"{got.shape} instead of {want.shape}"
    relative = name.endswith(".relative")
    rtol, atol = (tolerance(name), 0.0) if relative else (0.0, tolerance(name))
    np.testing.assert_allclose(got, want, rtol=rtol, atol=atol)
