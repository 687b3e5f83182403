"""Folders of files, local or in an object store: files are listed, fetched and written whole or not at all.

fsspec and its file systems speak to the store and try calls again. This module adds what they leave to their callers:
one error for whatever a store raises, local files that are replaced whole, and a check of the size of what was fetched.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import fsspec.core

from agent.core import AgentError, InputError, needed, written_whole

#: Prefix of the local folders for files on their way to or from a store.
SCRATCH = "agent-fleet-"


class StoreError(InputError):
    """A store did not give or take a file; another attempt may succeed."""


@dataclass(frozen=True)
class StoredFile:
    """A file by its path below the store's root, with its size [bytes] and a stamp that changes with its content: the
    ETag of an object, the time of change of a local file."""

    path: str
    size: int
    stamp: str

    @property
    def name(self) -> str:
        """Without its folder."""
        return PurePosixPath(self.path).name

    @property
    def folder(self) -> str:
        """ "." for the root."""
        return str(PurePosixPath(self.path).parent)


class Store:
    """The files below one folder or URL (`s3://bucket/logs`, or any other kind that fsspec supports)."""

    def __init__(self, url: str):
        self.url = str(url)
        if self.url.startswith(("s3:", "s3a:")):
            needed("s3fs", self.url)
        try:
            self._fs, root = fsspec.core.url_to_fs(self.url)
        except (ValueError, ImportError) as error:
            raise InputError(f"{self.url}: no store can be opened by this URL: {error}") from None
        except OSError as error:  # some connect at once
            raise InputError(f"{self.url}: no store answers there: {error.strerror or error}") from None
        self._root = root.rstrip("/") or "/"
        protocol = self._fs.protocol
        #: The folder, where it is one of this machine.
        self.local = Path(self._root) if "file" in ((protocol,) if isinstance(protocol, str) else protocol) else None

    @property
    def absolute(self) -> str:
        """The URL, or the whole path of a folder of this machine."""
        return self.url if self.local is None else str(self.local)

    def files(self) -> Iterator[StoredFile]:
        """All files, sorted by path, without those whose path has a part that begins with . or _.

        Raises:
            InputError: there is no such folder.
            StoreError: the store does not answer.
        """
        self._fs.invalidate_cache()
        with self._store_errors("listed"):
            details = self._fs.find(self._root, detail=True)
            if not details and not self._fs.isdir(self._root):
                raise InputError(f"{self.url}: no such folder, or nothing in it")
        for full in sorted(details):
            path, entry = full[len(self._root) :].lstrip("/"), details[full]
            if path and not any(part.startswith((".", "_")) for part in path.split("/")):
                yield StoredFile(path, int(entry["size"]), _stamp(entry))

    def find(self, path: str) -> StoredFile | None:
        """One file, where there is one."""
        with contextlib.suppress(FileNotFoundError), self._store_errors("found", path):
            entry = self._fs.info(f"{self._root}/{path}")
            return StoredFile(path, int(entry["size"] or 0), _stamp(entry))
        return None

    def fetch(self, file: StoredFile, folder: Path) -> Path:
        """Path of a local copy at the same relative path below `folder`, or of the file itself if it is local.

        Raises:
            StoreError: the store does not give the whole file.
        """
        if self.local is not None:
            return self.local / file.path
        path = folder / file.path
        path.parent.mkdir(parents=True, exist_ok=True)
        with self._store_errors("fetched", file.path):
            self._fs.get_file(f"{self._root}/{file.path}", str(path))
            if path.stat().st_size != file.size:
                raise OSError(f"{path.stat().st_size} of {file.size} bytes came")
        return path

    def read(self, path: str) -> bytes:
        """The content of a file.

        Raises:
            FileNotFoundError: there is none.
            StoreError: the store does not give it.
        """
        with self._store_errors("read", path):
            content: bytes = self._fs.cat_file(f"{self._root}/{path}")
        return content

    def put(self, path: str, content: bytes | Path) -> None:
        """Write a file; readers see the old content or all of the new.

        Raises:
            AgentError: it cannot be written.
        """
        full = f"{self._root}/{path}"
        if self.local is not None:
            _put_local(Path(full), content)
            return
        with self._store_errors("written", path):
            if isinstance(content, bytes):
                self._fs.pipe_file(full, content)
            else:
                self._fs.put_file(str(content), full)

    def names(self, folder: str) -> list[str]:
        """Sorted names of the files in a folder; none if there is no such folder."""
        self._fs.invalidate_cache()
        try:
            with self._store_errors("listed", folder):
                paths = self._fs.ls(f"{self._root}/{folder}", detail=False)
        except FileNotFoundError:
            return []
        return sorted(name for full in paths if not (name := PurePosixPath(full).name).startswith("."))

    def remove(self, path: str) -> None:
        """Delete a file, if it is there."""
        with contextlib.suppress(FileNotFoundError), self._store_errors("removed", path):
            self._fs.rm_file(f"{self._root}/{path}")

    @contextlib.contextmanager
    def _store_errors(self, what: str, path: str = "") -> Iterator[None]:
        """Raise what the store raises as an error that says what could not be done with which file."""
        where = f"{self.url}/{path}".rstrip("/") + f": cannot be {what}"
        try:
            yield
        except (FileNotFoundError, AgentError):
            raise
        except NotADirectoryError:
            raise InputError(f"{where}: a file is where a folder should be") from None
        except Exception as error:  # of the library that accesses the store
            reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise StoreError(f"{where}: {reason.splitlines()[0][:300]}") from None


def _put_local(path: Path, content: bytes | Path) -> None:
    """Write to a temporary name, flush to the disk and rename."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file to write")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(path) as unfinished:
            if isinstance(content, Path):
                shutil.copyfile(content, unfinished)
            else:
                unfinished.write_bytes(content)
    except (NotADirectoryError, FileExistsError):
        raise InputError(f"{path}: a file is where its folder should be; name another place") from None
    except OSError as error:
        raise AgentError(f"{path}: cannot be written: {error.strerror}; free space or rights?") from None


def _stamp(entry: dict[str, Any]) -> str:
    keys = ("ETag", "etag", "md5Hash", "mtime", "LastModified", "last_modified", "updated")
    return next((str(entry[key]).strip('"') for key in keys if entry.get(key)), "")
