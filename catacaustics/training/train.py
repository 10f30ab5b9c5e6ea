"""`catacaustics train`: a calibrated capture in, a trained scene out."""

from dataclasses import asdict
from pathlib import Path

from catacaustics.capture.dataset import open_capture
from catacaustics.config import TrainConfig
from catacaustics.errors import UserError
from catacaustics.files import write_json
from catacaustics.reflectors.volume import build_volume
from catacaustics.run import choose_device
from catacaustics.scene import Scene
from catacaustics.training.initialize import named_reflectors
from catacaustics.training.loop import Watch, fit
from catacaustics.training.selection import choose_models


def train(config: TrainConfig, watch: Watch | None = None) -> Scene:
    """Train a scene; where a model is `auto`, choose it first (RUN/model_choice.html tells why).

    Args:
        watch: called with the scene after every step, trials left out.

    Raises:
        UserError: no capture, no volume, an unfinished run without --resume, or a value that is not finite.
        KeyboardInterrupt: after the checkpoint was saved.
    """
    run = Path(config.run)
    capture = open_capture(config.capture)
    finished = run / "scene.safetensors"
    if finished.exists() and config.resume:
        print(f"training: {finished} is finished already, kept")
        return Scene.load(finished, choose_device(config.device))
    if not config.resume and (finished.exists() or (run / "checkpoint.safetensors").exists()):
        raise UserError(
            f"{run} already holds a run.", "an empty folder", "add --resume to go on, or choose another folder"
        )
    volumes = [build_volume(capture, name) for name in capture.reflectors]
    if not volumes:
        print("training: the capture has no masks, so no reflector; the primary cloud is trained alone")
    settings = asdict(config) | {"capture": str(Path(config.capture).resolve()), "run": str(run.resolve())}
    write_json(run / "config.json", settings)
    config = choose_models(capture, volumes, config)
    chosen = {k: v for k, v in asdict(config).items() if k not in ("capture", "run")}
    write_json(run / "config.json", settings | chosen)
    return fit(capture, named_reflectors(volumes, config.model), config, watch=watch)
