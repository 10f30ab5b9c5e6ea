"""One frozen dataclass a command: the same object is the Python API, the command line and config.json.

Fields without a default are positional arguments; the text below a field is its help.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Model = Literal[
    "auto", "none", "static", "plane", "sphere", "ellipsoid", "revolution", "concave", "neural", "quadric+neural"
]
"""Rungs of the ladder of warps (reflectors/warps.py); auto chooses by trials, none trains the primary cloud alone."""

CameraPath = Literal["held-out", "spline", "still"]
"""Camera paths of films."""


@dataclass(frozen=True)
class CalibrateConfig:
    """Photographs in, a calibrated capture with a fused point cloud out."""

    photos: Path
    """Folder of photographs, a COLMAP workspace (images/ and sparse/), or a folder with transforms.json."""
    capture: Path
    """Folder to write; finished stages found there are kept."""
    masks: Path | None = None
    """Reflector masks at the size of the photographs: MASKS/REFLECTOR/STEM.png, white = reflector."""
    max_size: int = 1600
    """Longer side of the undistorted photographs in pixels; larger photographs are reduced."""
    camera_model: Literal["SIMPLE_RADIAL", "OPENCV", "PINHOLE"] = "SIMPLE_RADIAL"
    """Lens model that structure from motion estimates."""
    held_out_every: int = 8
    """Every n-th photograph is held out for measuring."""
    stereo_size: int = 800
    """Longer side of the images that multi-view stereo works on."""


@dataclass(frozen=True)
class TrainConfig:
    """A calibrated capture in, a trained scene out. Learning rates of positions are relative to the scene's extent."""

    capture: Path
    """Folder made by `catacaustics calibrate`."""
    run: Path
    """Folder to write: scene.safetensors, checkpoint, metrics.jsonl, report.html."""
    model: tuple[Model, ...] = ("auto",)
    """What a reflector is: one name for all, or one for each in order of their names. auto chooses by short trials,
    none trains the primary cloud alone; concave is an ellipsoid seen from inside, revolution any turned shape."""
    resume: bool = False
    """Go on from the run's last checkpoint."""
    iterations: int = 30_000
    """Optimiser steps at most."""
    minutes: float | None = None
    """Stop after this much training time; schedules then follow time instead of steps."""
    clock: Literal["wall", "cpu"] = "wall"
    """What minutes are measured by; cpu: processor time of this process, fair where others use the machine too."""
    image_size: int = 1000
    """Longer side of the photographs in training; larger ones are reduced."""
    patch: int = 150
    """Side of the square training patches; photographs smaller than that are used whole."""
    accumulate: int = 1
    """Patches whose gradients are summed before a step (paper: 20)."""
    reflector_share: float = 0.5
    """Share of patches centred on a reflector; the others are anywhere."""
    primary_points: int | None = None
    """Primary points at the start, at most; the cloud is thinned at random. Left out, the images' size decides, and
    trials, where a model is auto and there are 30 minutes or more."""
    max_primary_points: int = 1_000_000
    """Densification never exceeds this."""
    reflection_points: int | None = None
    """Points of each reflector (paper: 400 000). Left out, its size in the images decides, and trials."""
    environment_width: int = 1000
    """Columns of the environment map (rows: 0.4 of it); 0 leaves it out."""
    warp_layers: int = 4
    warp_width: int = 256
    renderer_width: int = 32
    renderer_layers: int = 5
    densifications: int = 10
    """Times that the primary cloud is densified, evenly from the end of the warm-up to 80 % of the training (paper:
    every 2000 steps)."""
    densify_share: float = 0.05
    """Share of the points, those with the highest view-space gradients, that spawn a point each time."""
    weight_l1: float = 1.0
    """Paper: 0.05, which trains slower at every measure, DSSIM among them."""
    weight_dssim: float = 0.2
    weight_coverage: float = 0.01
    weight_rho: float = 0.01
    weight_tv: float = 1e-5
    lr_position: float = 1.6e-3
    lr_position_final: float = 1.6e-5
    lr_source: float = 2e-2
    """Of reflection points' positions, relative to their distance from the reflector; decays to 1/100."""
    lr_shape: float = 1e-2
    """Of a mirror's position, radii and rotation, relative to its radius and in radians; decays to 1/50."""
    lr_normal: float = 3e-3
    lr_footprint: float = 2e-2
    lr_opacity: float = 0.2
    lr_features: float = 2.5e-2
    lr_environment: float = 5e-4
    """Of the environment map's features: seen by few photographs, they learn noise at the rate of points."""
    lr_final_share: float = 0.1
    """Rates of normals, footprints, opacities, features and the environment map decay to this share of their start."""
    lr_network: float = 1e-3
    lr_network_final: float = 1e-4
    warp_weight_decay: float = 1e-2
    guesses: bool | None = None
    """Start from stereo's guesses, too. Left out: no, or as a trial decides where a model is auto."""
    refine_poses: bool | None = None
    """Learn corrections of the training poses. Left out: no, or as trials of 30 minutes and more decide."""
    exposure: bool | None = None
    """Learn exposure and white balance (three gains) of each training photograph; left out, as refine_poses."""
    lr_pose: float = 1e-3
    """Of corrections of camera poses, in radians and relative to the cameras' extent; decays to 1/10."""
    lr_exposure: float = 5e-3
    """Of the logarithms of exposure gains; decays to 1/10."""
    checkpoint_minutes: float = 2.0
    view: bool = False
    """Open the viewer on the scene in training; it closes with it."""
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"


@dataclass(frozen=True)
class AblateConfig:
    """Measure what each part is worth: the paper's ablations and every rung, at equal time and equal iterations."""

    capture: Path
    """Folder made by `catacaustics calibrate`."""
    out: Path
    """Folder to write: ablation.json, .html and .svg (the chart); finished rows found there are kept."""
    minutes: float | None = 1.0
    """Training time of each row in the comparison at equal time; None leaves it out."""
    clock: Literal["wall", "cpu"] = "wall"
    """What minutes are measured by; cpu: processor time of this process, fair where others use the machine too."""
    iterations: int | None = None
    """Steps of each row in the comparison at equal iterations; None leaves it out."""
    rows: tuple[str, ...] = ()
    """Names of the rows to train; none named means all."""
    cloud_rungs: tuple[Model, ...] = ("sphere",)
    """Rungs that are also trained with a quarter and with half of the usual reflection points."""
    seeds: tuple[int, ...] = (0,)
    """One training a seed; the table gives means and spreads."""
    image_size: int = 480
    """Longer side of the photographs in training."""
    truth: Path | None = None
    """The capture with ground truth of reflections, where the calibrated one is a copy without."""
    json: Path | None = None
    """Write the results to this file too."""
    device: Literal["auto", "cpu", "cuda"] = "auto"


@dataclass(frozen=True)
class EvaluateConfig:
    """Measure a trained scene on its held-out views; writes metrics.json and report.html into the run's folder."""

    run: Path
    """Folder that training wrote."""
    capture: Path | None = None
    """The capture, where it is no longer at the place that training noted."""
    shown_views: int = 12
    """Held-out views with pictures in the report, spread evenly; all of them are measured."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to render; auto takes the GPU if there is one."""


@dataclass(frozen=True)
class RenderConfig:
    """Render a video of a trained scene along a camera path."""

    run: Path
    """Folder that training wrote."""
    video: Path
    """MP4 file to write. Finished frames are kept beside it until it is complete."""
    path: CameraPath = "held-out"
    """held-out: through the held-out views in order; spline: a tour of the training views, nearest neighbour next;
    still: the first held-out view."""
    layers: tuple[Literal["rgb", "primary", "reflection", "weight", "depth"], ...] = ("rgb",)
    """What to show; several layers stand side by side."""
    warp_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Reflections follow a camera displaced by this along the view's axes (right, down, forward; world units)."""
    warp_path: CameraPath | None = None
    """Reflections follow a camera on this path, whatever the view's; the offset comes on top."""
    warp_reflector: str | None = None
    """Only this reflector's reflections follow another camera; left out, all."""
    seconds: float = 10.0
    """Length of the video."""
    fps: float = 24.0
    """Frames per second."""
    width: int = 800
    """Width of each layer in pixels; the height follows from the camera."""
    quality: int = 20
    """Constant rate factor of H.264: lower is better and larger, 18 is visually lossless."""
    capture: Path | None = None
    """The capture, where it is no longer at the place that training noted."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to render; auto takes the GPU if there is one."""


@dataclass(frozen=True)
class EditConfig:
    """Change a scene's reflections; writes a new run that can be rendered, viewed and edited again."""

    run: Path
    """Folder that training wrote."""
    out: Path
    """Folder to write."""
    reflector: str | None = None
    """Name of the reflector, where there are several."""
    strength: float = 1.0
    """Brightness of the reflections; 0 erases them."""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Colour that reflections are multiplied with (RGB)."""
    surroundings: Path | None = None
    """Latitude-longitude image that the reflector shall mirror instead, its top row up."""
    surroundings_turn: float = 0.0
    """Turn of that image about the vertical, in degrees."""
    warp_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Reflections follow a camera displaced by this from the view's (world units and axes)."""
    warp_gain: float = 1.0
    """The reflections' camera moves this many times as fast as the view's; 0 freezes reflections."""
    warp_pivot: tuple[float, float, float] | None = None
    """Where both cameras are at the same place; left out, at the first held-out view."""
    warp_strength: float = 1.0
    """Share of the way from the view's camera to the reflections' camera that is gone; 0 leaves all as it is."""
    device: Literal["auto", "cpu", "cuda"] = "auto"


@dataclass(frozen=True)
class CloneConfig:
    """Copy a reflector with its reflections to another place; writes a new run."""

    run: Path
    """Folder that training wrote."""
    out: Path
    """Folder to write."""
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where to, from the original, in world units."""
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation in degrees, as a vector along its axis."""
    scale: float = 1.0
    """Size of the copy."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Copy the primary points between these corners (x y z x y z) instead of those in the reflection volume."""
    surroundings: Literal["moved", "resting"] = "moved"
    """moved: as if its surroundings had come along; resting: as a real mirror would where it stands."""
    reflector: str | None = None
    """Name of the reflector, where there are several."""
    device: Literal["auto", "cpu", "cuda"] = "auto"


@dataclass(frozen=True)
class StereoConfig:
    """Stereo pictures of a scene, with comfortable reflections on request; writes them into a folder."""

    run: Path
    """Folder that training wrote."""
    out: Path
    """Folder to write: left.png, right.png, anaglyph.png, side_by_side.png, stereo.json, film.mp4."""
    warp_separation: float = 1.0
    """The reflections' share of the eye separation: 1 is physically right, 0 the most comfortable."""
    separation: float | None = None
    """Between the eyes, in world units; left out, a thirtieth of the distance to the screen."""
    screen: float | None = None
    """Distance of what has no disparity; left out, of the front of the nearest reflector."""
    view: str | None = None
    """The photograph whose camera stands between the eyes; left out, the first held-out one."""
    film: Literal["side-by-side", "anaglyph"] | None = None
    """Also write film.mp4 along the path."""
    path: CameraPath = "held-out"
    """Of the film, as in `catacaustics render`."""
    seconds: float = 10.0
    fps: float = 24.0
    width: int = 800
    """Width of one eye's picture in pixels."""
    quality: int = 20
    """Constant rate factor of H.264: lower is better and larger."""
    capture: Path | None = None
    """The capture, where it is no longer at the place that training noted."""
    device: Literal["auto", "cpu", "cuda"] = "auto"


@dataclass(frozen=True)
class TrackConfig:
    """Follow reflected points from view to view: pixel tracks as CSV and JSON, a picture and a film with dots."""

    run: Path
    """Folder that training wrote."""
    out: Path
    """Folder to write: tracks.csv, tracks.json, tracks.jpg, tracks.mp4."""
    view: str | None = None
    """The photograph in whose view points are chosen; left out, the first held-out one."""
    pixels: tuple[float, ...] = ()
    """Follow what is reflected at these pixels of the view at `width`: X Y X Y ..."""
    points: tuple[int, ...] = ()
    """Follow these points of the reflection cloud."""
    count: int = 12
    """Where neither is given: this many points, spread over the reflector."""
    reflector: str | None = None
    """Name of the reflector, where there are several."""
    least_weight: float = 0.05
    """A point is visible where it has at least this share of the pixel at its middle."""
    truth: Path | None = None
    """The path-traced capture with truth/, where the run's capture is a copy without; errors are then measured."""
    film: bool = True
    """Write the film too."""
    path: CameraPath = "held-out"
    """The views to follow the points in, as in `catacaustics render`."""
    seconds: float = 5.0
    fps: float = 24.0
    width: int = 480
    """Width of the views in pixels."""
    quality: int = 20
    """Constant rate factor of H.264: lower is better and larger."""
    capture: Path | None = None
    """The capture, where it is no longer at the place that training noted."""
    device: Literal["auto", "cpu", "cuda"] = "auto"


@dataclass(frozen=True)
class ExportConfig:
    """Take a scene elsewhere: clouds, 3D Gaussians, mirrors and volumes as PLY, cameras as COLMAP and JSON."""

    run: Path
    """Folder that training wrote."""
    out: Path
    """Folder to write."""
    view: str | None = None
    """Colours are as seen from this photograph's camera; left out, from the first held-out one."""
    photographs: bool = False
    """Copy the photographs into OUT/images; otherwise the cameras' files refer to the capture's."""
    capture: Path | None = None
    """The capture, where it is no longer at the place that training noted."""
    device: Literal["auto", "cpu", "cuda"] = "auto"


@dataclass(frozen=True)
class ReconstructConfig:
    """Photographs in, a trained scene with its report out: calibrate, train and evaluate in one go.

    Run the same command again after an interruption: it goes on at the first unfinished stage.
    """

    photos: Path
    """Folder of photographs, a COLMAP workspace, a folder with transforms.json, or a calibrated capture."""
    out: Path
    """Folder to write: capture/ (cameras and points) and run/ (scene and report)."""
    masks: Path | None = None
    """Reflector masks at the size of the photographs: MASKS/REFLECTOR/STEM.png, white = reflector."""
    model: tuple[Model, ...] = ("auto",)
    """What a reflector is: one name for all, or one for each in order of their names. auto chooses by short trials,
    none trains the primary cloud alone; concave is an ellipsoid seen from inside, revolution any turned shape."""
    iterations: int = 30_000
    """Optimiser steps at most."""
    minutes: float | None = None
    """Stop training after this much time; schedules then follow time instead of steps."""
    image_size: int = 1000
    """Longer side of the photographs in training."""
    primary_points: int | None = None
    """Primary points at the start, at most; left out, it is decided by image size and trials."""
    reflection_points: int | None = None
    """Points of each reflector; left out, it is decided by image size and trials."""
    warp_width: int = 256
    """Width of the neural warp's hidden layers (paper: 256); 128 trains twice as many steps a minute on a CPU."""
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"


@dataclass(frozen=True)
class MaskConfig:
    """Paint the masks of reflectors in the browser, and see at once what volume they make."""

    capture: Path
    """Folder made by `catacaustics calibrate`."""
    import_: Path | None = None
    """Take masks made with any editor, FOLDER/REFLECTOR/STEM.png at the size of the capture's photographs, and exit.
    They replace all masks of those reflectors; the old ones are kept in removed_masks/."""
    browser: bool = True
    """Open the page in the browser; its address is printed in any case."""
    port: int = 8642
    """Port on 127.0.0.1; where it is in use, any free one is taken."""


@dataclass(frozen=True)
class ViewConfig:
    """Walk through a trained scene, or one in training, in the browser."""

    run: Path
    """Folder that training wrote, or writes."""
    capture: Path | None = None
    """The capture, where it is no longer at the place that training noted."""
    image_size: int = 1000
    """Longer side of a picture in pixels when the camera stands still."""
    browser: bool = True
    """Open the page in the browser; its address is printed in any case."""
    port: int = 8643
    """Port on 127.0.0.1; where it is in use, the next free one is taken."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to render; auto takes the GPU if there is one."""


@dataclass(frozen=True)
class RefractDataConfig:
    """Make a data set for refraction baking: views of a glass scene with G-buffers, R-buffers and references."""

    scene: str
    """cornell, hemisphere, checker or tir."""
    out: Path
    """Folder to write; finished shards found there are kept."""
    train: int = 240
    """Frames to train on, with path-traced references."""
    val: int = 24
    test: int = 36
    generator: int = 600
    """More frames to train the R-buffer generator on, without references; they cost little."""
    resolution: int = 128
    """Side of the square images in pixels."""
    screen: int = 1024
    """Side of the screen-space colour buffer in pixels."""
    spp: int = 100
    """Samples a pixel of the references, rounded up to a whole grid of strata."""
    ranges: tuple[str, ...] = ()
    """Ranges other than the scene's own, as NAME=LOW:HIGH or NAME=VALUE; the card lists names and ranges."""
    seed: int = 0
    processes: int = 2
    variant: Literal["auto", "cuda_ad_rgb", "llvm_ad_rgb"] = "auto"
    """Mitsuba variant; auto takes CUDA where it works."""


RefractModel = Literal["glassnet", "crystalnet", "ssnrb", "direct", "hybrid"]
"""Renderers: without R-buffer; with texture, world or screen coordinates from their generator; with world coordinates
looked up on the screen and by a probe."""


@dataclass(frozen=True)
class RefractTrainConfig:
    """Train a refraction model: its R-buffer generator on coordinates, then its renderer with the generator frozen.

    The defaults are for minutes on a CPU. The papers: --size paper --crop 0 --lr-generator 7.5e-5 --lr-renderer 1e-4
    --lr-final-share 1 --weight-index 1 --weight-normal 2 --weight-direction 0 --crop-generator 0, for hours on a GPU.
    """

    data: Path
    """Folder made by `catacaustics refract data`."""
    run: Path
    """Folder to write: generator and renderer, checkpoints, metrics.jsonl."""
    model: RefractModel = "hybrid"
    """glassnet has no R-buffer, crystalnet looks colours up by texture coordinates, ssnrb on the screen by world
    coordinates, direct by screen coordinates (ablation), hybrid by paths through baked bodies, there or by a probe."""
    part: Literal["both", "generator", "renderer"] = "both"
    """Train only one; the renderer needs a trained generator in the run or in --generator."""
    generator: Path | None = None
    """Trained generator.safetensors to take instead of training one."""
    resume: bool = False
    """Go on from the run's last checkpoint."""
    size: Literal["small", "base", "paper"] = "small"
    """Of the networks: 16, 32 or 64 channels in the first level."""
    minutes: float | None = None
    """Stop after this much training time of both parts together; schedules then follow time instead of steps. Reading
    frames ahead and baking R-buffers for the renderer, once, do not count."""
    generator_share: float = 0.5
    """Of the minutes; glassnet gives them all to its renderer, hybrid what its generator does not need."""
    steps: int = 20_000
    """Optimiser steps of each part, at most."""
    clock: Literal["wall", "cpu"] = "wall"
    """What minutes are measured by; cpu: processor time of this process, fair where others use the machine too."""
    batch: int = 8
    crop: int = 32
    """Side in pixels of the renderer's square training crops, `batch` of them a step; 0 takes whole images."""
    batch_generator: int = 16
    crop_generator: int = 16
    """The same for the generator. Many small crops tell more than few large ones: each comes from another frame."""
    glass_share: float = 0.8
    """Share of the crops centred on a refractive pixel; the others are anywhere."""
    lr_generator: float = 4e-3
    lr_renderer: float = 2e-3
    lr_final_share: float = 0.01
    """Rates fall to this share of their start along a half cosine; 1 keeps them."""
    weight_decay: float = 1e-4
    weight_coordinates: float = 1.0
    weight_direction: float = 2.0
    """Direction from the first surface to the landing point (papers: 0): it does not depend on how far things are."""
    weight_tv: float = 1.5e-8
    """Total variation of coordinates, summed over an image."""
    weight_index: float = 0.1
    weight_normal: float = 0.2
    """Of the object landed on (cross entropy) and normals there (papers: 1 and 2, too much in a short training)."""
    weight_l1: float = 1.0
    weight_dssim: float = 1.0
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Of the training's convolutions; auto takes bfloat16 where the processor or GPU computes with it. Trained networks
    are always run in float32."""
    content: Literal["both", "color", "normal"] = "both"
    """What the renderer gets of the R-buffer."""
    coordinates: Literal["predicted", "true"] = "predicted"
    """true: the renderer learns and is measured with the true landing points, as a perfect generator would give them:
    how good the lookups could be. No generator is trained."""
    cache_gb: float = 4.0
    """Memory for frames that are kept; others are read from disk each time."""
    checkpoint_minutes: float = 2.0
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"


@dataclass(frozen=True)
class RefractEvaluateConfig:
    """Measure a trained refraction model on held-out frames: metrics, speed, pictures side by side."""

    run: Path
    """Folder that `catacaustics refract train` wrote."""
    data: Path | None = None
    """The data set, where it is not the one of the training."""
    split: Literal["test", "val", "train"] = "test"
    shown_frames: int = 8
    """Frames with pictures in the report, spread over the split."""
    device: Literal["auto", "cpu", "cuda"] = "auto"


@dataclass(frozen=True)
class RefractReportConfig:
    """Train refraction models for equal seconds with several seeds and compare them: table, chart, pictures.

    Run the same command again after an interruption: finished trainings are kept.
    """

    data: Path
    """Folder made by `catacaustics refract data`."""
    out: Path
    """Folder to write: report.html, comparison.json, table.md and the trained models, runs/MODEL_SIZE_SEED."""
    models: tuple[RefractModel, ...] = ("glassnet", "crystalnet", "ssnrb", "direct", "hybrid")
    sizes: tuple[Literal["small", "base", "paper"], ...] = ("small",)
    """Of the networks; with several, the chart of speed against error has a line a model."""
    seeds: tuple[int, ...] = (0, 1, 2)
    minutes: float = 20.0
    """Training time of each model, generator and renderer together."""
    generator_share: float = 0.5
    """Of the minutes; glassnet gives them all to its renderer, hybrid what its generator does not need."""
    coordinates: Literal["predicted", "true"] = "predicted"
    """true: renderers get true landing points, for their share of the minutes: the best that lookups can give."""
    clock: Literal["wall", "cpu"] = "wall"
    """What minutes are measured by; cpu: processor time of this process, fair where others use the machine too."""
    split: Literal["test", "val", "train"] = "test"
    shown_frames: int = 6
    """Frames with pictures of all models."""
    device: Literal["auto", "cpu", "cuda"] = "auto"


@dataclass(frozen=True)
class RefractViewConfig:
    """Move the objects, the light and the index of refraction of a trained refraction model in the browser."""

    run: Path
    """Folder that `catacaustics refract train` wrote."""
    data: Path | None = None
    """The data set, where it is not the one of the training."""
    browser: bool = True
    """Open the page in the browser; its address is printed in any case."""
    port: int = 8644
    """Port on 127.0.0.1; where it is in use, any free one is taken."""
    device: Literal["auto", "cpu", "cuda"] = "auto"


@dataclass(frozen=True)
class DoctorConfig:
    """What is installed, what it can do here, and what would make it faster."""
