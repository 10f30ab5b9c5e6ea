"""Atomic files: a reader sees the old content or the new one, never half of either."""

import errno
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from catacaustics.errors import UserError


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it to `path` when the block succeeds, remove it when it fails.

    The temporary name keeps the suffix, because image and video writers choose their format by it.

    Raises:
        UserError: the disk is full or the folder cannot be written.
    """
    path = Path(path)
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise UserError(
                f"No space left while writing {path}.",
                "enough free disk space; everything finished before this file is intact",
                "free some space and run the same command again; it goes on from the last finished stage",
            ) from error
        if error.errno in (errno.EACCES, errno.EROFS, errno.EPERM, errno.ENOTDIR):
            raise UserError(
                f"Cannot write {path}: {error.strerror}.",
                "a folder that this user may write to",
                "choose another output folder or change its permissions",
            ) from error
        raise
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> None:
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    write_text(path, json.dumps(value, indent=2) + "\n")


def read_json(path: Path) -> Any:
    """Parse a JSON file.

    Raises:
        UserError: the file is missing or is not JSON.
    """
    try:
        return json.loads(Path(path).read_text())
    except FileNotFoundError as error:
        raise UserError(
            f"There is no file {path}.", "a JSON file", "run the stage that writes it, or check the path"
        ) from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise UserError(
            f"{path} is not valid JSON: {error}.",
            "a complete JSON file",
            "delete the file and run the stage that writes it again",
        ) from error


def write_tensors(path: Path, tensors: dict[str, Any], header: dict[str, Any]) -> None:
    """Write named PyTorch tensors and a JSON header as one safetensors file, atomically."""
    from safetensors.torch import save_file

    ready = {name: value.detach().contiguous().cpu() for name, value in tensors.items()}
    with atomic_path(path) as temporary:
        save_file(ready, temporary, {"catacaustics": json.dumps(header)})


def read_tensors(path: Path, what: str, command: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """What `write_tensors` wrote.

    Args:
        what: what the file holds, for messages ("scene").
        command: the command that writes it, for messages ("catacaustics train").

    Raises:
        UserError: the file is missing or cut off.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            header = json.loads((file.metadata() or {}).get("catacaustics", "{}"))
            return {k: file.get_tensor(k) for k in file.keys()}, header  # noqa: SIM118 (not a dict)
    except FileNotFoundError as error:
        raise UserError(f"There is no {what} {path}.", f"a file made by `{command}`", "train first") from error
    except (SafetensorError, OSError, ValueError) as error:
        raise UserError(
            f"{path} is not a complete {what} file: {error}.",
            f"a safetensors file made by `{command}`",
            "restore it, or train again with --resume: the last checkpoint is kept beside it",
        ) from error
