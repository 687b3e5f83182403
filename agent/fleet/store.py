"""Folders of files, local or in an object store: files are listed, fetched and written whole or not at all.

A store may answer slowly, with errors, or with half a file. Every call is retried with growing pauses. A fetched file
is compared with the size in the store's listing, and with the MD5 where the listing has one.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from agent.core import AgentError, InputError, needed, written_whole

#: Attempts before a store counts as unavailable, and the first pause between them [s]; each is twice the last.
TRIES = 4
PAUSE = 0.25
#: Prefix of the local folders for files on their way to or from a store.
SCRATCH = "agent-fleet-"

Answer = TypeVar("Answer")


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
    """The files below one folder or URL (`s3://bucket/logs`, and whatever else fsspec knows)."""

    def __init__(self, url: str):
        self.url = str(url)
        needed("fsspec", "a fleet")
        options = {}
        if self.url.startswith(("s3:", "s3a:")):
            needed("s3fs", self.url)
            options = {"config_kwargs": {"retries": {"max_attempts": 1}}}  # calls are tried again here, and by s3fs
        from fsspec.core import url_to_fs

        try:
            self._fs, root = url_to_fs(self.url, **options)
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
        found = self._try(lambda: self._fs.find(self._root, detail=True), "listed")
        if not found and not self._try(lambda: self._fs.isdir(self._root), "listed"):
            raise InputError(f"{self.url}: no such folder, or nothing in it")
        for full in sorted(found):
            path, entry = full[len(self._root) :].lstrip("/"), found[full]
            if path and not any(part.startswith((".", "_")) for part in path.split("/")):
                yield StoredFile(path, int(entry["size"]), _stamp(entry))

    def find(self, path: str) -> StoredFile:
        """One file.

        Raises:
            FileNotFoundError: there is none.
        """
        entry = self._try(lambda: self._fs.info(f"{self._root}/{path}"), "found", path)
        return StoredFile(path, int(entry["size"] or 0), _stamp(entry))

    def fetch(self, file: StoredFile, folder: Path) -> Path:
        """Path of a local copy at the same place below `folder`, or of the file itself where it is local.

        Raises:
            StoreError: the store does not give the whole file.
        """
        if self.local is not None:
            return self.local / file.path
        path = folder / file.path
        path.parent.mkdir(parents=True, exist_ok=True)

        def download() -> None:
            self._fs.get_file(f"{self._root}/{file.path}", str(path))
            _check_whole(path, file)

        self._try(download, "fetched", file.path)
        return path

    def read(self, path: str) -> bytes:
        """The content of a file.

        Raises:
            FileNotFoundError: there is none.
            StoreError: the store does not give it.
        """
        return self._try(lambda: self._fs.cat_file(f"{self._root}/{path}"), "read", path)

    def put(self, path: str, content: bytes | Path) -> None:
        """Write a file; readers see the old content or all of the new.

        Raises:
            AgentError: it cannot be written.
        """
        full = f"{self._root}/{path}"
        if self.local is not None:
            _put_local(Path(full), content)
        elif isinstance(content, bytes):
            self._try(lambda: self._fs.pipe_file(full, content), "written", path)
        else:
            self._try(lambda: self._fs.put_file(str(content), full), "written", path)

    def names(self, folder: str) -> list[str]:
        """Sorted names of the files in a folder; none if there is no such folder."""
        self._fs.invalidate_cache()
        try:
            found = self._try(lambda: self._fs.ls(f"{self._root}/{folder}", detail=False), "listed", folder)
        except FileNotFoundError:
            return []
        return sorted(name for full in found if not (name := PurePosixPath(full).name).startswith("."))

    def remove(self, path: str) -> None:
        """Delete a file, if it is there."""
        with contextlib.suppress(FileNotFoundError):
            self._try(lambda: self._fs.rm_file(f"{self._root}/{path}"), "removed", path)

    def _try(self, call: Callable[[], Answer], what: str, path: str = "") -> Answer:
        where = f"{self.url}/{path}".rstrip("/") + f": cannot be {what}"
        for number in range(1, TRIES + 1):
            try:
                return call()
            except FileNotFoundError:
                raise
            except NotADirectoryError:
                raise InputError(f"{where}: a file is where a folder should be") from None
            except (PermissionError, IsADirectoryError) as error:  # another try does not mend it
                raise StoreError(f"{where}: {error.strerror or error}") from None
            except Exception as error:  # of whatever library speaks to the store
                if number == TRIES:
                    said = str(error).splitlines()[0][:300] if str(error) else type(error).__name__
                    raise StoreError(f"{where}, tried {TRIES} times: {said}") from None
            time.sleep(PAUSE * 2 ** (number - 1))
        raise AssertionError


def _put_local(path: Path, content: bytes | Path) -> None:
    """Write to a temporary name, flush to the disk and rename."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file to write")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(path) as beside:
            if isinstance(content, Path):
                shutil.copyfile(content, beside)
            else:
                beside.write_bytes(content)
    except (NotADirectoryError, FileExistsError):
        raise InputError(f"{path}: a file is where its folder should be; name another place") from None
    except OSError as error:
        raise AgentError(f"{path}: cannot be written: {error.strerror}; free space or rights?") from None


def _check_whole(path: Path, file: StoredFile) -> None:
    """Raises OSError where what came is not what the listing says."""
    size = path.stat().st_size
    if size != file.size:
        raise OSError(f"{size} of {file.size} bytes came")
    if re.fullmatch("[0-9a-f]{32}", file.stamp):  # an object of one part; of several it is no MD5
        with open(path, "rb") as content:
            if hashlib.file_digest(content, lambda: hashlib.md5(usedforsecurity=False)).hexdigest() != file.stamp:
                raise OSError("what came is not what is stored: its MD5 is another")


def _stamp(entry: dict[str, Any]) -> str:
    keys = ("ETag", "etag", "md5Hash", "mtime", "LastModified", "last_modified", "updated")
    return next((str(entry[key]).strip('"') for key in keys if entry.get(key)), "")
