"""The main job in one call: photographs in, rendered reflections out. Finished stages are kept."""

from dataclasses import fields
from pathlib import Path

from catacaustics.capture.calibrate import calibrate
from catacaustics.capture.dataset import Capture
from catacaustics.config import CalibrateConfig, EvaluateConfig, ReconstructConfig, TrainConfig
from catacaustics.evaluation import evaluate
from catacaustics.reflectors.volume import build_volume, write_volume
from catacaustics.training.train import train


def reconstruct(config: ReconstructConfig) -> Path:
    """Calibrate, build reflection volumes, train, evaluate. Returns the path of the report.

    Raises:
        UserError: from whichever stage meets bad input; what earlier stages made stays.
    """
    capture_path, run = Path(config.out) / "capture", Path(config.out) / "run"
    capture = calibrate(CalibrateConfig(config.photos, capture_path, config.masks))
    _write_volumes(capture)
    shared = {f.name for f in fields(ReconstructConfig)} & {f.name for f in fields(TrainConfig)}
    train(TrainConfig(capture_path, run, resume=True, **{name: getattr(config, name) for name in shared}))
    evaluate(EvaluateConfig(run))
    return run / "report.html"


def _write_volumes(capture: Capture) -> None:
    """Reflection volumes beside the masks, for viewers and editors; training builds the same ones."""
    for name in capture.reflectors:
        volume = build_volume(capture, name)
        write_volume(capture, volume)
        print(f"volume: {name} has {len(volume.halfspaces)} planes, radius {volume.radius:.4g}")
