"""`catacaustics mask`: the mask painter as a page that this machine serves to its own browser."""

import hashlib
import json
import os
import secrets
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from catacaustics.capture.dataset import Capture, open_capture
from catacaustics.config import MaskConfig
from catacaustics.errors import UserError
from catacaustics.images import encode_image, resize
from catacaustics.web.guard import Guard
from catacaustics.web.masks import MaskStore, StaleMask, decode_runs, encode_runs, import_masks, revision
from catacaustics.web.outline import outline_scribble
from catacaustics.web.proposal import look_at_point, propose_views

STATIC = Path(__file__).with_name("static")
_THUMBNAIL = 320
_SHOWN_AS_THEY_ARE = {".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".png": "image/png", ".webp": "image/webp"}
_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}


def mask(config: MaskConfig) -> None:
    """Serve the painter until interrupted, or import masks and return.

    Raises:
        UserError: no capture, or masks that do not fit it.
    """
    capture = open_capture(config.capture)
    if config.import_ is not None:
        _import(MaskStore(capture), config.import_)
        return
    serve(
        painter_app(capture),
        config.port,
        config.browser,
        f"Mask painter for {capture.root}",
        "Masks are saved as you paint. Ctrl+C stops the server.",
        f"The masks are in {capture.root / 'masks'}",
    )


def serve(app: Starlette, port: int, browser: bool, title: str, hint: str, end: str) -> None:
    """Serve an application behind the guard until interrupted; prints its address, and opens it where there is a
    screen.

    Args:
        port: on 127.0.0.1; where it is in use, any free one is taken.
        title, hint, end: what is printed with the address, below it, and after the server has stopped.
    """
    with _listen(port) as listener:
        port = listener.getsockname()[1]
        token = secrets.token_urlsafe(16)
        address = f"http://127.0.0.1:{port}/{token}/"
        print(f"{title}:\n\n    {address}\n", flush=True)
        if browser and has_screen():
            threading.Timer(0.5, webbrowser.open, [address]).start()
        else:
            print(f"From another machine: ssh -N -L {port}:127.0.0.1:{port} THIS_MACHINE, then open the address there.")
        print(hint, flush=True)
        settings = uvicorn.Config(
            Guard(app, token, port),
            log_level="warning",
            access_log=False,
            server_header=False,
            ws="none",
            timeout_graceful_shutdown=2,
        )
        # uvicorn ends by itself, and passes the interrupt on where this process does not ignore it.
        with suppress(KeyboardInterrupt):
            uvicorn.Server(settings).run(sockets=[listener])
        print(f"\nStopped. {end}")


def has_screen() -> bool:
    """Whether a browser can be opened here; without a screen some systems would open one in the terminal."""
    return sys.platform in ("darwin", "win32") or "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ


def _listen(port: int) -> socket.socket:
    """A socket on 127.0.0.1 at this port, or at any free one where it is in use."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(("127.0.0.1", port))
    except OSError:
        listener.bind(("127.0.0.1", 0))
    return listener


def _import(store: MaskStore, folder: Path) -> None:
    for name, count in import_masks(store, folder).items():
        print(f"masks: {count} of {name} imported")
        report = store.save_volume(name)
        if report["mesh"]:
            print(f"volume: {name} has radius {report['mesh']['radius']:.4g}")
        if report["problem"]:
            problem = report["problem"]
            print(f"{problem['found']}\n  expected: {problem['expected']}\n  what to do: {problem['remedy']}")


def painter_app(capture: Capture) -> Starlette:
    """The painter's pages and its interface, without the guard that belongs before it."""
    store = MaskStore(capture)
    pages = {f"/static/{path.name}": path for path in STATIC.iterdir() if path.suffix in _TYPES}

    @lru_cache(maxsize=512)
    def thumbnail(view: int) -> bytes:
        store.photograph(view)
        image = capture.image(capture.views[view])
        scale = _THUMBNAIL / max(image.shape[:2])
        width, height = (max(round(side * scale), 1) for side in (image.shape[1], image.shape[0]))
        return encode_image(resize(image, width, height), ".jpg", 85)

    def photograph(request: Request) -> Response:
        view = _view(store, request.path_params["view"])
        headers = {"cache-control": "private, max-age=3600"}
        if "small" in request.query_params:
            return Response(thumbnail(view), media_type="image/jpeg", headers=headers)
        path = store.photograph(view)
        kind = _SHOWN_AS_THEY_ARE.get(path.suffix.lower())
        if kind is not None:
            return FileResponse(path, media_type=kind, headers=headers)
        return Response(encode_image(capture.image(capture.views[view]), ".jpg"), media_type="image/jpeg")

    def page(request: Request) -> Response:
        path = STATIC / "index.html" if request.url.path == "/" else pages[request.url.path]
        return FileResponse(path, media_type=_TYPES[path.suffix], headers={"cache-control": "no-cache"})

    def masks(request: Request) -> Response:
        reflector = request.query_params.get("reflector", "")
        found = {i: store.mask(reflector, i) for i in store.masked_views(reflector)}
        return JSONResponse({i: {"runs": encode_runs(m), "revision": revision(m)} for i, m in found.items()})

    def save(body: dict[str, Any]) -> dict[str, Any]:
        reflector, view = _text(body, "reflector"), _view(store, body.get("view"))
        camera = capture.views[view].camera
        new = store.save_mask(
            reflector, view, decode_runs(body.get("runs", []), camera.width, camera.height), _text(body, "revision")
        )
        return {"revision": new, "report": store.save_volume(reflector)}

    def report(body: dict[str, Any]) -> dict[str, Any]:
        changed = {}
        for key, runs in _table(body, "masks").items():
            view = _view(store, key)
            camera = capture.views[view].camera
            changed[view] = decode_runs(runs, camera.width, camera.height)
        return store.report(_text(body, "reflector"), changed)

    def outline(body: dict[str, Any]) -> dict[str, Any]:
        view = _view(store, body.get("view"))
        camera = capture.views[view].camera
        scribble = decode_runs(body.get("runs", []), camera.width, camera.height)
        store.photograph(view)
        found = outline_scribble(capture.image(capture.views[view]), scribble, by_color=body.get("by") == "color")
        return {"runs": encode_runs(found)}

    def note(body: dict[str, Any]) -> dict[str, Any]:
        store.note_reflectors({name: str(color) for name, color in _table(body, "reflectors").items()})
        return {}

    def rename(body: dict[str, Any]) -> dict[str, Any]:
        store.rename(_text(body, "from"), _text(body, "to"))
        return {"report": store.save_volume(_text(body, "to"))}

    def delete(body: dict[str, Any]) -> dict[str, Any]:
        kept = store.delete(_text(body, "name"))
        return {"kept": str(kept) if kept else None}

    actions = {"save": save, "report": report, "outline": outline, "reflectors": note, "rename": rename}
    actions["delete"] = delete
    return Starlette(
        routes=[
            Route("/", page),
            *(Route(path, page) for path in pages),
            Route("/api/state", lambda request: JSONResponse(_state(store))),
            Route("/api/masks", masks),
            Route("/api/photo/{view:int}", photograph),
            *(Route(f"/api/{name}", json_action(function), methods=["POST"]) for name, function in actions.items()),
        ],
        exception_handlers={UserError: user_error_answer, StaleMask: _stale},
    )


def json_action(function: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[Request], Any]:
    """An endpoint that takes and gives JSON; the work is done in a thread."""

    async def endpoint(request: Request) -> Response:
        try:
            body = json.loads(await request.body())
        except (ValueError, RecursionError) as error:
            raise HTTPException(400, "The request is not JSON.") from error
        if not isinstance(body, dict):
            raise HTTPException(400, "The request is not a JSON object.")
        return JSONResponse(await run_in_threadpool(function, body))

    return endpoint


def user_error_answer(request: Request, error: Exception) -> Response:
    """A UserError as JSON: found, expected, remedy."""
    assert isinstance(error, UserError)
    return JSONResponse({"found": error.found, "expected": error.expected, "remedy": error.remedy}, 422)


def _stale(request: Request, error: Exception) -> Response:
    assert isinstance(error, StaleMask)
    return JSONResponse({"runs": encode_runs(error.mask), "revision": revision(error.mask)}, 409)


def _text(body: dict[str, Any], key: str) -> str:
    if not isinstance(body.get(key), str):
        raise HTTPException(400, f"{key} is missing.")
    return body[key]


def _table(body: dict[str, Any], key: str) -> dict[str, Any]:
    if not isinstance(body.get(key), dict):
        raise HTTPException(400, f"{key} is missing.")
    return body[key]


def _view(store: MaskStore, value: Any) -> int:
    """A view's index from a request; in JSON objects keys are strings."""
    if isinstance(value, str) and value.isdecimal() and len(value) < 10:
        value = int(value)
    if type(value) is not int or not 0 <= value < len(store.views):
        raise HTTPException(404, f"There is no view {value}.")
    return value


def _state(store: MaskStore) -> dict[str, Any]:
    """What the page needs at the start."""
    capture = store.capture
    train = [view.camera for view in capture.train]
    target, painted = look_at_point(train), []
    for name in list(store.reflectors())[:1]:
        painted = [i for i in store.masked_views(name) if i < len(train)]
        with suppress(UserError):
            target = store.volume(name)[0].center
    proposed = set(propose_views(train, target, painted=painted))
    centers = np.array([view.camera.center for view in store.views])
    reach = float(np.median(np.linalg.norm(centers - target, axis=-1)))
    views = []
    for i, view in enumerate(store.views):
        c = view.camera
        corners = c.unproject(
            np.array([[0, 0], [c.width, 0], [c.width, c.height], [0, c.height]], float), np.full(4, 0.1 * reach)
        )
        views.append(
            {
                "name": view.name,
                "width": c.width,
                "height": c.height,
                "train": i < len(train),
                "proposed": i in proposed,
                "center": c.center.round(6).tolist(),
                "corners": corners.round(6).tolist(),
            }
        )
    up = -np.mean([c.camera_from_world[1, :3] for c in train], axis=0)
    return {
        "capture": capture.root.resolve().name,
        "id": hashlib.sha256(str(capture.root.resolve()).encode()).hexdigest()[:12],
        "views": views,
        "target": target.round(6).tolist(),
        "up": up.tolist(),
        "reach": reach,
        "reflectors": [{"name": name, "color": color} for name, color in store.reflectors().items()],
    }
