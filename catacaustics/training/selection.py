"""Model selection: short trials decide what a scene needs, scored on training views that the trials do not see.

The rule. Rungs are walked from the simplest to the most complex. A more complex one takes the place of the best so far
only if its mean gain in PSNR inside the reflector exceeds both 0.2 dB and twice the standard error of the gains per
view: what the noise of a few views could explain is not a reason. The environment map, stereo's guesses and larger
clouds must earn their place by the same rule, judged on the whole image and inside the reflectors. All trials get the
same steps; where the choice among rungs is close, the best of them go on for twice as many, and again, and the rule is
asked among them. What the masks rule out is not tried: spheres for flat things, surfaces
of revolution where the visual hull is none.
"""

import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from catacaustics.capture.dataset import Capture
from catacaustics.config import TrainConfig
from catacaustics.files import read_json, write_json, write_text
from catacaustics.metrics import psnr
from catacaustics.reflectors.volume import ReflectionVolume
from catacaustics.run import clock_of
from catacaustics.scene import Scene
from catacaustics.training.choice_page import choice_html
from catacaustics.training.corrections import align_view
from catacaustics.training.initialize import Reflector, named_reflectors, scene_extent, usual_points
from catacaustics.training.loop import fit
from catacaustics.training.mirrors import impossible_shapes
from catacaustics.training.photographs import photograph, scaled_camera

LADDER = ("none", "static", "plane", "sphere", "ellipsoid", "revolution", "concave", "neural", "quadric+neural")
"""Rungs from the simplest to the most complex."""

_NETWORKS = ("neural", "quadric+neural")
"""Left out where there are less than `_PATIENT` minutes: trials would be too short for a network to learn anything."""

LEAST_GAIN = 0.2
"""dB that a more complex candidate must gain at least."""

_STEPS, _LEAST_STEPS = 250, 50
"""Steps of a trial; with less than `_PATIENT` minutes fewer in proportion: trials take about a third of them."""
_FINALISTS = (4, 2)
"""Rungs at most that go on for twice as many steps, then again: a mirror's lead over a static cloud grows with them."""
_CLOSE = 1.0
"""dB below the rule's pick at most, for a rung to go on with it."""
_SIZE, _PATCH = 200, 100
"""Longer side of the images, and of the patches, in trials."""
_FACTORS = (0.5, 1.0, 2.0)
"""Sizes of a cloud that are tried, in units of `usual_points`."""
_PATIENT = 30
"""Minutes of training from which on networks, sizes of clouds and corrections of the photographs are tried."""
_VIEWS = 8
"""Validation views at most."""


@dataclass(frozen=True)
class Trial:
    """What a candidate was and reached.

    Args:
        name: what was tried.
        question: what it was tried for: model, environment, reflection points or primary points.
        settings: fields of TrainConfig in which it differs.
        rounds: length of the trial in units of the usual steps.
        seconds: of the trial, or of what was added to the shorter one.
        steps, points, parameters: of the trial; points of all clouds, parameters besides points.
        inside: PSNR in dB inside each reflector, a list of views each (None where a view does not show it).
        whole: PSNR in dB of the whole image, a list of views.
    """

    name: str
    question: str
    settings: dict
    rounds: int
    seconds: float
    steps: int
    points: int
    parameters: int
    inside: list[list[float | None]]
    whole: list[float]


def gain(new: Sequence[float | None], old: Sequence[float | None]) -> tuple[float, float]:
    """Mean of the paired differences over views, and the gain that noise could explain (never below LEAST_GAIN)."""
    differences = np.array(new, float) - np.array(old, float)
    differences = differences[np.isfinite(differences)]
    if not len(differences):
        return 0.0, LEAST_GAIN
    error = differences.std(ddof=1) / np.sqrt(len(differences)) if len(differences) > 1 else np.inf
    return float(differences.mean()), float(max(LEAST_GAIN, 2 * error))


def best(scores: Sequence[Sequence[float | None]]) -> int:
    """Index of the candidate to take: the first, unless a later one wins by more than the noise."""
    chosen = 0
    for i in range(1, len(scores)):
        difference, noise = gain(scores[i], scores[chosen])
        if difference > noise:
            chosen = i
    return chosen


def finalists(scores: Sequence[Sequence[float | None]], most: int) -> list[int]:
    """Indices of the candidates that a longer trial could put first: the rule's pick and those close to it or above,
    `most` at most."""
    pick = best(scores)
    leads = [gain(s, scores[pick])[0] for s in scores]
    others = sorted((i for i in range(len(scores)) if i != pick and leads[i] > -_CLOSE), key=lambda i: -leads[i])
    return sorted([pick, *others[: most - 1]])


def choose_models(capture: Capture, volumes: list[ReflectionVolume], config: TrainConfig) -> TrainConfig:
    """The configuration with every `auto` decided; nothing to do where none is. Writes RUN/model_choice.json and
    RUN/model_choice.html; an earlier choice found there is kept, and so are finished trials.

    The trials' time is taken from the training's minutes.
    """
    if not volumes:
        return replace(config, model=("none",))
    reflectors = named_reflectors(volumes, config.model)
    if not any(r.model == "auto" for r in reflectors):
        return config
    trials = _Trials(capture, volumes, config)
    hurried = _hurried(config)  # no networks, usual sizes, an environment map, photographs as they are
    untried = [_untried(r, capture, hurried) for r in reflectors]
    for reflector, rungs in zip(reflectors, untried, strict=True):
        for rung, why in rungs.items():
            print(f"model selection: {rung} is not tried for {reflector.volume.name}: {why}")
    models = _models(trials, reflectors, untried)
    chosen: dict = {"model": tuple(models)}
    taken = {"model": models}
    if config.environment_width and not hurried:
        without = trials.run("no environment map", "environment", chosen | {"environment_width": 0})
        base = trials.run("environment map", "environment", chosen)
        if best([without.whole, base.whole]) == 0:
            chosen["environment_width"] = 0
        taken["environment"] = [(without, base)[best([without.whole, base.whole])].name]
    if config.guesses is None and capture.has_guesses:
        base = trials.run("seen by three views", "stereo", chosen)
        filled = trials.run("guesses too", "stereo", chosen | {"guesses": True})
        chosen["guesses"] = best([base.whole, filled.whole]) == 1
        taken["stereo"] = [(base, filled)[chosen["guesses"]].name]
    for question, field in (("reflection points", "reflection_points"), ("primary points", "primary_points")):
        if hurried or getattr(config, field) is not None or (field == "reflection_points" and set(models) == {"none"}):
            continue
        usual = usual_points(capture, volumes, trials.config)[field]
        tried = {f"{int(factor * usual):,} ({factor:g} x usual)": {field: int(factor * usual)} for factor in _FACTORS}
        done = [trials.run(name, question, chosen | settings) for name, settings in tried.items()]
        index = best([_joined(t) if field == "reflection_points" else t.whole for t in done])
        taken[question] = [done[index].name]
        chosen[field] = int(_FACTORS[index] * usual_points(capture, volumes, config)[field])
    chosen |= {} if hurried else _photographs(trials, config, chosen, taken)
    trials.finish(chosen, taken, [v.name for v in volumes], untried)
    minutes = None if config.minutes is None else max(config.minutes - trials.seconds / 60, 0.25 * config.minutes)
    return replace(config, minutes=minutes, **chosen)


def _untried(reflector: Reflector, capture: Capture, hurried: bool) -> dict[str, str]:
    """The rungs that a reflector cannot be, and why."""
    if reflector.model != "auto":
        return {}
    networks = dict.fromkeys(_NETWORKS, f"takes more than {_PATIENT} minutes") if hurried else {}
    return networks | impossible_shapes(reflector.volume, capture)


def _models(trials: "_Trials", reflectors: list[Reflector], untried: list[dict[str, str]]) -> list[str]:
    """A rung for each reflector, by trials that get longer for fewer; in a trial all reflectors to be decided have the
    same one."""

    def run(left: dict[int, list[int]], rounds: int) -> dict[int, list[list[float | None]]]:
        tried = {k: {"model": _filled(reflectors, LADDER[k])} for k in sorted(set().union(*left.values()))}
        done = {k: trials.run(LADDER[k], "model", settings, rounds) for k, settings in tried.items()}
        return {i: [done[k].inside[i] for k in rungs] for i, rungs in left.items()}

    free = [i for i, r in enumerate(reflectors) if r.model == "auto"]
    left = {i: [k for k, rung in enumerate(LADDER) if rung not in untried[i]] for i in free}
    scores = run(left, 1)
    for turn, most in enumerate(_FINALISTS, 1):
        left |= {i: [left[i][k] for k in finalists(scores[i], most)] for i in scores}
        scores = run({i: rungs for i, rungs in left.items() if len(rungs) > 1}, 2**turn)
    taken = {i: LADDER[rungs[best(scores[i]) if i in scores else 0]] for i, rungs in left.items()}
    return [taken.get(i, r.model) for i, r in enumerate(reflectors)]


def _photographs(trials: "_Trials", config: TrainConfig, chosen: dict, taken: dict[str, list[str]]) -> dict:
    """Do poses or exposures need corrections? Scored on views aligned in both, so that neither has an advantage."""
    free = [key for key in ("refine_poses", "exposure") if getattr(config, key) is None]
    if not free:
        return {}
    names = {"refine_poses": "camera poses", "exposure": "exposure"}
    options: list[dict] = [{key: False for key in free}]
    options += [{key: key == one for key in free} for one in free]
    options += [{key: True for key in free}] if len(free) > 1 else []
    done = [
        trials.run(" and ".join(names[k] for k in free if o[k]) or "as they are", "photographs", chosen | o)
        for o in options
    ]
    index = best([t.whole for t in done])
    taken["photographs"] = [done[index].name]
    return options[index]


def _hurried(config: TrainConfig) -> bool:
    return config.minutes is not None and config.minutes < _PATIENT


def _steps(config: TrainConfig) -> int:
    share = 1.0 if config.minutes is None else min(1.0, config.minutes / _PATIENT)
    return max(_LEAST_STEPS, round(_STEPS * share))


def _filled(reflectors: list, rung: str) -> tuple[str, ...]:
    return tuple(rung if r.model == "auto" else r.model for r in reflectors)


def _joined(trial: Trial) -> list[float | None]:
    return [score for scores in trial.inside for score in scores]


class _Trials:
    """Runs trials and keeps their results in RUN/model_choice.json."""

    def __init__(self, capture: Capture, volumes: list[ReflectionVolume], config: TrainConfig):
        # At least two validation views, and most views left to learn from.
        views = capture.train
        every = max(3, len(views) // _VIEWS)
        self.validation = views[every // 2 :: every][:_VIEWS]
        self.capture = replace(capture, train=[v for v in views if v not in self.validation], held_out=[])
        self.volumes = volumes
        self.run_folder = Path(config.run)
        size = min(_SIZE, config.image_size)
        named = {k: getattr(config, k) for k in ("primary_points", "reflection_points")}
        self.config = replace(
            config,
            **{k: n and max(500, int(n * (size / config.image_size) ** 2)) for k, n in named.items()},
            image_size=size,
            iterations=min(_steps(config), config.iterations),
            minutes=None,
            patch=_PATCH,
            accumulate=1,
            environment_width=min(config.environment_width, 200),
            resume=False,
        )
        self._key = {k: str(v) for k, v in asdict(config).items() if k not in ("run", "resume")}
        self.done = self._read()

    @property
    def seconds(self) -> float:
        return sum({(str(t.settings), t.rounds): t.seconds for t in self.done}.values())

    def run(self, name: str, question: str, settings: dict, rounds: int = 1) -> Trial:
        """The result of a trial of `rounds` times the usual steps, run now, found, or gone on with."""
        found = [t for t in self.done if t.name == name and t.question == question]
        if found and found[-1].rounds >= rounds:
            return next(t for t in found if t.rounds == rounds)
        same = [t for t in self.done if dict(t.settings) == _plain(settings) and question != "photographs"]
        if same and same[0].question != question:
            trial = replace(same[0], name=name, question=question)
        else:
            folder = self.run_folder / "trials" / name.replace(" ", "_")
            if not found:
                shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True, exist_ok=True)
            config = replace(self.config, run=folder, iterations=rounds * self.config.iterations, **settings)
            print(f"model selection: {question}, {name}{', finalist' if rounds > 1 else ''}")
            clock = clock_of(config.clock)
            started = clock()
            scene = fit(self.capture, named_reflectors(self.volumes, config.model), config)
            trial = self._scored(scene, name, question, settings, rounds, folder)
            trial = replace(trial, seconds=clock() - started)
        self.done.append(trial)
        write_json(self.run_folder / "model_choice.json", {"key": self._key, "trials": [asdict(t) for t in self.done]})
        return trial

    def finish(
        self, chosen: dict, taken: dict[str, list[str]], reflectors: list[str], untried: list[dict[str, str]]
    ) -> None:
        result = {
            "key": self._key,
            "chosen": _plain(chosen),
            "taken": taken,
            "reflectors": reflectors,
            "untried": untried,
            "trials": [asdict(t) for t in self.done],
        }
        write_json(self.run_folder / "model_choice.json", result)
        for heavy in (self.run_folder / "trials").glob("*/*.safetensors"):
            heavy.unlink()
        write_text(self.run_folder / "model_choice.html", choice_html(self.run_folder, result, LEAST_GAIN))
        words = ", ".join(f"{k} {' '.join(map(str, v)) if isinstance(v, tuple) else v}" for k, v in chosen.items())
        print(f"model selection: {words}; why: {self.run_folder / 'model_choice.html'}")

    def _read(self) -> list[Trial]:
        path = self.run_folder / "model_choice.json"
        if not path.is_file():
            return []
        kept = read_json(path)
        return [Trial(**t) for t in kept["trials"]] if kept.get("key") == self._key else []

    def _scored(self, scene: Scene, name: str, question: str, settings: dict, rounds: int, folder: Path) -> Trial:
        inside: list[list[float | None]] = [[] for _ in self.volumes]
        whole = []
        for view in self.validation:
            camera = scaled_camera(view.camera, self.config.image_size, 1.0)
            photo = photograph(self.capture, view, camera)
            if question == "photographs":
                target, extent = torch.from_numpy(photo).to(scene.device), scene_extent(self.capture)
                image = align_view(scene, camera, target, True, True, extent).render(scene, camera).cpu().numpy()
            else:
                image = scene.render(camera).rgb.cpu().numpy()
            whole.append(psnr(image, photo))
            for scores, volume in zip(inside, self.volumes, strict=True):
                mask = volume.project_mask(camera)
                scores.append(psnr(image[mask], photo[mask]) if mask.any() else None)
        points = sum(len(c) for c in (scene.primary, *scene.reflections))
        parameters = sum(
            p.numel() for n, p in scene.named_parameters() if n.startswith(("warps", "renderer", "environment"))
        )
        steps = len((folder / "metrics.jsonl").read_text().splitlines()) * 10
        return Trial(name, question, _plain(settings), rounds, 0.0, steps, points, parameters, inside, whole)


def _plain(settings: dict) -> dict:
    """As JSON gives it back."""
    return {k: list(v) if isinstance(v, tuple) else v for k, v in settings.items()}
