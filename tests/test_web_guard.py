"""Who is served: nobody without the token, no foreign page, no path, no flood. And the command that serves."""

import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import httpx2
import numpy as np
import pytest
import uvicorn
from starlette.testclient import TestClient
from toy import ball_mask, make_toy_capture

from catacaustics import cli
from catacaustics.capture.dataset import open_capture
from catacaustics.images import read_mask, write_image
from catacaustics.web.guard import MAX_BODY, Guard
from catacaustics.web.masks import encode_runs
from catacaustics.web.server import STATIC, painter_app

TOKEN, PORT = "s3cret-token", 8642
HOST = f"127.0.0.1:{PORT}"


@pytest.fixture(scope="module")
def toy(tmp_path_factory) -> Path:
    return make_toy_capture(tmp_path_factory.mktemp("toy") / "capture", masks=False, points=False)


@pytest.fixture
def root(toy, tmp_path) -> Path:
    return shutil.copytree(toy, tmp_path / "capture")


@pytest.fixture
def client(root) -> TestClient:
    return TestClient(Guard(painter_app(open_capture(root)), TOKEN, PORT), base_url=f"http://{HOST}")


def toy_mask(root: Path, view: int) -> np.ndarray:
    return ball_mask(open_capture(root).views[view].camera)


def a_save(root: Path) -> dict:
    return {"reflector": "ball", "view": 0, "runs": encode_runs(toy_mask(root, 0)), "revision": "empty"}


# Who is refused ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path", ["/", "/wrong/", "/api/state", f"/{TOKEN}x/", f"/{TOKEN[:-1]}/", f"/x/{TOKEN}/", f"/{TOKEN}"]
)
def test_without_the_token_nothing_is_served(client, path):
    answer = client.get(path)
    assert answer.status_code == 403
    assert TOKEN not in answer.text
    assert client.get(f"/{TOKEN}/").status_code == 200


@pytest.mark.parametrize(
    "host", ["evil.example", f"evil.example:{PORT}", "127.0.0.1", "127.0.0.1:80", f"{HOST}.evil.example", ""]
)
def test_a_foreign_host_is_refused(client, host):
    assert client.get(f"/{TOKEN}/api/state", headers={"host": host}).status_code == 421
    assert client.get(f"/{TOKEN}/api/state", headers={"host": f"localhost:{PORT}"}).status_code == 200


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", f"https://{HOST}", "http://127.0.0.1:80", f"http://{HOST}.evil.example"]
)
def test_a_foreign_origin_is_refused_and_changes_nothing(client, root, origin):
    answer = client.post(f"/{TOKEN}/api/save", json=a_save(root), headers={"origin": origin})
    assert answer.status_code == 403
    assert not (root / "masks").exists()
    own = {"origin": f"http://{HOST}"}
    assert client.post(f"/{TOKEN}/api/save", json=a_save(root), headers=own).status_code == 200


def test_requests_that_other_pages_make_a_browser_send_are_refused(client, root):
    for site in ("cross-site", "same-site"):
        assert client.get(f"/{TOKEN}/api/state", headers={"sec-fetch-site": site}).status_code == 403
    plain = client.post(f"/{TOKEN}/api/save", content=json.dumps(a_save(root)), headers={"content-type": "text/plain"})
    assert plain.status_code == 415  # a form of another page can send that, but not JSON
    assert not (root / "masks").exists()


@pytest.mark.parametrize("method", ["PUT", "DELETE", "PATCH", "OPTIONS"])
def test_other_methods_are_refused(client, method):
    answer = client.request(method, f"/{TOKEN}/api/save", headers={"content-type": "application/json"})
    assert answer.status_code == 405
    assert "access-control-allow-origin" not in answer.headers


def test_pages_may_not_be_framed_nor_load_anything_from_elsewhere(client):
    for path in ("", "static/main.js", "api/state", "no-such-page"):
        headers = client.get(f"/{TOKEN}/{path}").headers
        assert headers["content-security-policy"].startswith("default-src 'self'")
        assert "frame-ancestors 'none'" in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"


def test_every_static_file_is_served_and_names_no_other_place(client):
    for path in STATIC.iterdir():
        name = "" if path.name == "index.html" else f"static/{path.name}"
        answer = client.get(f"/{TOKEN}/{name}")
        assert answer.status_code == 200
        links = re.findall(r"https?://[^ \"'<]+", answer.text)
        assert set(links) <= {"http://www.w3.org/2000/svg"}, path.name


# Against a real server, with bytes that no client library would send -------------------------------------------------


@contextmanager
def serving(root: Path):
    """A server in a thread; yields its port."""
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    app = Guard(painter_app(open_capture(root)), TOKEN, port)
    server = uvicorn.Server(uvicorn.Config(app, log_level="critical", timeout_graceful_shutdown=1))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        while not server.started:
            time.sleep(0.01)
        yield port
    finally:
        server.should_exit = True
        thread.join(10)


def raw(port: int, request: str, body=()) -> str:
    """Send a request as it is; returns the status line and what follows."""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall(f"{request} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n".encode())
        try:
            for part in body:
                connection.sendall(part)
        except (BrokenPipeError, ConnectionResetError):
            pass  # it hung up: what it said before can still be read
        answer = b""
        try:
            while part := connection.recv(65536):
                answer += part
        except ConnectionResetError:
            pass
    return answer.decode("latin-1")


def test_no_path_leads_out(root, tmp_path):
    (tmp_path / "secret.txt").write_text("the secret")
    paths = ["..", "../secret.txt", "static/../../secret.txt", "static/..%2f..%2fsecret.txt", "%2e%2e/secret.txt"]
    paths += ["static//etc/passwd", "static/../server.py", "api/photo/../../secret.txt", "api/photo/-1", "api/photo/10"]
    paths += [
        "api/photo/0%00",
        "static/..\\server.py",
        "api/masks?reflector=../../secret",
        "api/masks?reflector=%2e%2e",
    ]
    with serving(root) as port:
        for path in paths:
            answer = raw(port, f"GET /{TOKEN}/{path}", [b"Connection: close\r\n\r\n"])
            assert re.match(r"HTTP/1.1 (400|403|404|422) ", answer), (path, answer[:80])
            assert "the secret" not in answer
            assert "root:" not in answer
        assert raw(port, f"GET /{TOKEN}/api/photo/9", [b"Connection: close\r\n\r\n"]).startswith("HTTP/1.1 200")


def test_a_body_of_a_gigabyte_is_refused_before_it_is_sent_and_a_stream_of_it_is_cut_off(root):
    kind = b"Content-Type: application/json\r\n"
    sent = 0

    def flood():
        nonlocal sent
        yield kind + b"Transfer-Encoding: chunked\r\n\r\n"
        for _ in range(1024):
            yield b"100000\r\n" + bytes(2**20) + b"\r\n"
            sent += 2**20

    with serving(root) as port:
        start = time.perf_counter()
        answer = raw(port, f"POST /{TOKEN}/api/save", [kind + b"Content-Length: 1073741824\r\n\r\n"])
        assert answer.startswith("HTTP/1.1 413")
        raw(port, f"POST /{TOKEN}/api/save", flood())
        assert time.perf_counter() - start < 10
        assert sent < 4 * MAX_BODY
        again = raw(port, f"GET /{TOKEN}/api/state", [b"Connection: close\r\n\r\n"])
        assert again.startswith("HTTP/1.1 200")


def test_a_chunked_body_over_the_limit_is_answered(client):
    def parts():
        for _ in range(20):
            yield bytes(2**20)

    answer = client.post(f"/{TOKEN}/api/save", content=parts(), headers={"content-type": "application/json"})
    assert answer.status_code == 413


@pytest.mark.parametrize(
    ("path", "body", "status"),
    [
        ("save", "{", 400),
        ("save", "[]", 400),
        ("save", "[" * 100_000, 400),
        ("save", "{}", 400),
        ("save", '{"reflector": "ball", "view": 99, "runs": [], "revision": ""}', 404),
        ("save", '{"reflector": "ball", "view": true, "runs": [], "revision": ""}', 404),
        ("save", '{"reflector": "ball", "view": 0, "runs": [1], "revision": ""}', 422),
        ("save", '{"reflector": "ball", "view": 0, "runs": [1e99], "revision": ""}', 422),
        ("save", '{"reflector": 5, "view": 0, "runs": [3072], "revision": ""}', 400),
        ("report", '{"reflector": "ball", "masks": {"..": [3072]}}', 404),
        ("report", '{"reflector": "ball", "masks": []}', 400),
        ("outline", '{"view": 0, "runs": {"a": 1}}', 422),
        ("reflectors", '{"reflectors": {"ball": "url(x)"}}', 422),
    ],
)
def test_nonsense_is_answered_with_words_not_with_a_crash(client, root, path, body, status):
    answer = client.post(f"/{TOKEN}/api/{path}", content=body, headers={"content-type": "application/json"})
    assert answer.status_code == status
    assert not (root / "masks").exists()


# The command ---------------------------------------------------------------------------------------------------------


def test_the_command_prints_an_address_on_this_machine_only_and_stops_when_interrupted(root):
    command = [sys.executable, "-m", "catacaustics.cli", "mask", str(root), "--no-browser", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            lines = [process.stdout.readline() for _ in range(6)]
            address = re.search(r"http://127\.0\.0\.1:(\d+)/([\w-]{20,})/", "".join(lines))
            assert address
            deadline = time.monotonic() + 10
            while True:
                try:
                    assert httpx2.get(address[0] + "api/state").json()["capture"] == "capture"
                    break
                except httpx2.ConnectError:
                    assert time.monotonic() < deadline
                    time.sleep(0.05)
            listening = Path("/proc/net/tcp").read_text() if Path("/proc/net/tcp").exists() else ""
            assert f"00000000:{int(address[1]):04X}" not in listening
            process.send_signal(signal.SIGINT)
            rest = process.stdout.read()
        finally:
            process.kill()
    assert "Stopped. The masks are in" in rest


def test_two_painters_on_one_port_get_two_ports():
    from catacaustics.web.server import _listen

    with _listen(0) as first:
        port = first.getsockname()[1]
        first.listen()
        with _listen(port) as second:
            assert second.getsockname()[1] != port


def write_masks(folder: Path, root: Path, views, suffix=".png"):
    for view in views:
        name = Path(open_capture(root).views[view].name).with_suffix(suffix)
        write_image(folder / "ball" / name, toy_mask(root, view))


def test_masks_from_any_editor_are_imported_with_their_volume(root, tmp_path, capsys):
    write_masks(tmp_path / "mine", root, [0, 3])
    write_masks(tmp_path / "mine", root, [6], ".bmp")
    (tmp_path / "mine" / "notes.txt").write_text("not a mask")
    assert cli.main(["mask", str(root), "--import", str(tmp_path / "mine")]) == 0
    words = capsys.readouterr().out
    assert "3 of ball imported" in words
    assert "volume: ball has radius" in words
    for view in (0, 3, 6):
        assert np.array_equal(read_mask(root / "masks" / "ball" / f"view_{view:02d}.png"), toy_mask(root, view))
    assert (root / "volumes" / "ball.json").is_file()


def test_imported_masks_replace_those_before_which_are_kept_aside(root, tmp_path, capsys):
    write_masks(tmp_path / "first", root, [0, 1, 2])
    write_masks(tmp_path / "second", root, [0, 3, 6])
    for name in ("first", "second"):
        assert cli.main(["mask", str(root), "--import", str(tmp_path / name)]) == 0
    assert "removed_masks" in capsys.readouterr().out
    assert sorted(p.stem for p in (root / "masks" / "ball").iterdir()) == ["view_00", "view_03", "view_06"]
    assert sorted(p.stem for p in (root / "removed_masks" / "ball").iterdir()) == ["view_00", "view_01", "view_02"]


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda mask: np.repeat(np.repeat(mask, 2, 0), 2, 1), ["view_03", "128 x 96", "64 x 48"]),
        (lambda mask: np.zeros_like(mask), ["view_03", "all black"]),
    ],
)
def test_masks_that_do_not_fit_are_refused_by_name_and_nothing_is_imported(root, tmp_path, capsys, spoil, words):
    write_masks(tmp_path / "mine", root, [0, 3, 6])
    path = tmp_path / "mine" / "ball" / "view_03.png"
    write_image(path, spoil(read_mask(path)))
    assert cli.main(["mask", str(root), "--import", str(tmp_path / "mine")]) == 2
    message = capsys.readouterr().err
    for word in [*words, "nothing was imported", "what to do"]:
        assert word in message
    assert not (root / "masks").exists()


def test_masks_that_leave_the_volume_open_are_imported_and_the_reason_is_told(root, tmp_path, capsys):
    write_masks(tmp_path / "mine", root, [0])
    assert cli.main(["mask", str(root), "--import", str(tmp_path / "mine")]) == 0
    assert "leave its volume open" in capsys.readouterr().out


def test_a_folder_that_is_no_capture_is_refused(tmp_path, capsys):
    assert cli.main(["mask", str(tmp_path)]) == 2
    assert "catacaustics calibrate" in capsys.readouterr().err
