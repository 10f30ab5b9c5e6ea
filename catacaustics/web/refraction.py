"""`catacaustics refract view`: frames of a trained refraction model, with sliders for what can move in its scene.

The G-buffers of every new frame are ray-cast here; no path is traced, unless the reference is asked for.
"""

import base64
import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from catacaustics.config import RefractViewConfig
from catacaustics.errors import UserError
from catacaustics.files import read_json
from catacaustics.images import encode_image
from catacaustics.refraction.evaluate import render_frame
from catacaustics.refraction.frames import Frame, open_frames
from catacaustics.refraction.models import RefractionModel, load_model
from catacaustics.run import choose_device
from catacaustics.web.server import json_action, serve, user_error_answer

PAGE = Path(__file__).with_name("refraction_page")
_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
SHOWN = ("model", "colour looked up", "true colour", "direct light", "path traced")
_REFERENCE_SPP = 64
MakeFrame = Callable[[np.ndarray, int], Frame]
"""A frame for parameters in [0, 1] and samples a pixel of its reference (0: none)."""


def view_refraction(config: RefractViewConfig) -> None:
    """Serve the page until interrupted.

    Raises:
        UserError: training has not finished, no data set, or no usable Mitsuba.
    """
    settings = read_json(Path(config.run) / "config.json")
    frames = open_frames(Path(config.data or settings["data"]))
    model = load_model(config.run, frames, choose_device(config.device))
    view = RefractionView(model, frames.card, frame_maker(frames.card), settings.get("content", "both"))
    title = f"{model.name} on {frames.card['scene']}"
    serve(refraction_app(view), config.port, config.browser, title, "Ctrl+C stops the server.", "")


def frame_maker(card: dict[str, Any]) -> MakeFrame:
    """Makes frames of the data set's scene at its resolution."""
    from catacaustics.refraction.data import frame_at
    from catacaustics.refraction.scenes import find_scene, with_ranges
    from catacaustics.refraction.variants import VECTORISED, choose_variant

    scene = with_ranges(find_scene(card["scene"]), card["settings"]["ranges"])

    def make(share: np.ndarray, spp: int) -> Frame:
        choose_variant("auto", VECTORISED)
        return frame_at(scene, share, card["resolution"], card["screen"], spp)

    return make


class RefractionView:
    """Renders pictures for the page, one at a time in one thread: Mitsuba belongs to the thread that started it.

    Args:
        card: the data set's; its parameters are the sliders.
        content: what the renderer was trained to get of the R-buffer.
    """

    def __init__(self, model: RefractionModel, card: dict[str, Any], make: MakeFrame, content: str = "both"):
        self.model, self.make, self.content = model, make, content
        self.scene = str(card["scene"])
        self.parameters = [{k: p[k] for k in ("name", "low", "high")} for p in card["parameters"]]
        self.thread = ThreadPoolExecutor(1)

    def state(self) -> dict[str, Any]:
        """What the page needs at the start."""
        shown = [s for s in SHOWN if s != "colour looked up" or self.model.kind]
        return {"scene": self.scene, "model": self.model.name, "parameters": self.parameters, "shown": shown}

    def render(self, values: list[float], shown: str) -> dict[str, Any]:
        """A picture as a data address, and the milliseconds that buffers and model took.

        Args:
            values: of the parameters, in their own units.

        Raises:
            UserError: the camera stands badly.
        """
        return self.thread.submit(self._render, values, shown).result()

    def _render(self, values: list[float], shown: str) -> dict[str, Any]:
        low, high = (np.array([p[k] for p in self.parameters]) for k in ("low", "high"))
        share = np.clip((np.array(values) - low) / (high - low), 0, 1)
        started = time.perf_counter()
        frame = self.make(share, _REFERENCE_SPP if shown == "path traced" else 0)
        made = time.perf_counter()
        view = render_frame(self.model, frame, self.content)
        done = time.perf_counter()
        pictures = {
            "model": view.image,
            "colour looked up": view.looked_up,
            "true colour": view.true_color,
            "direct light": frame.direct,
            "path traced": frame.reference,
        }
        picture = base64.b64encode(encode_image(pictures[shown], ".png")).decode()
        return {
            "picture": f"data:image/png;base64,{picture}",
            "buffers_ms": round(1000 * (made - started)),
            "model_ms": round(1000 * (done - made)),
        }


def refraction_app(view: RefractionView) -> Starlette:
    """The page and its interface, without the guard that belongs before it."""
    pages = {f"/{path.name}": path for path in PAGE.iterdir() if path.suffix in _TYPES}

    def page(request: Request) -> Response:
        path = PAGE / "index.html" if request.url.path == "/" else pages[request.url.path]
        return FileResponse(path, media_type=_TYPES[path.suffix], headers={"cache-control": "no-cache"})

    def render(body: dict[str, Any]) -> dict[str, Any]:
        values, shown = body.get("values"), body.get("shown")
        wanted = len(view.parameters)
        if (
            not isinstance(values, list)
            or len(values) != wanted
            or not all(type(v) in (int, float) and math.isfinite(v) for v in values)
        ):
            raise HTTPException(400, f"values must be {wanted} numbers.")
        if not isinstance(shown, str) or shown not in view.state()["shown"]:
            raise HTTPException(400, f"shown must be one of {', '.join(view.state()['shown'])}.")
        return view.render([float(value) for value in values], shown)

    return Starlette(
        routes=[
            Route("/", page),
            *(Route(path, page) for path in pages),
            Route("/api/state", lambda request: JSONResponse(view.state())),
            Route("/api/render", json_action(render), methods=["POST"]),
        ],
        exception_handlers={UserError: user_error_answer},
    )
