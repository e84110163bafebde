"""A run on disk: one folder with a journal in SQLite, frames beside it, and what was derived from them.

A pose is committed in one transaction after its frames are safely on the disk; it is there in full or not at all, also
after ``kill -9``. Every row has a CRC-32 of its own, every frame file a SHA-256. The store knows nothing of devices, and
never alters a committed pose; only samples, which are derived, can be written again.
"""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gonio.errors import DatasetError
from gonio.interfaces import Frame
from gonio.lock import FileLock, HeldError
from gonio.samples import BRDFSamples, SharedError
from gonio.scan import frames as frame_files
from gonio.scan.journal import DATABASE, Journal, insert
from gonio.scan.records import BlockRecord, PoseRecord, from_json, to_json

Kind = Literal["scan", "import"]


class Run:
    """A run's folder. Make one with `Run.create`, open one with `Run.open`; a context manager.

    Attributes
    ----------
    path : Path
    kind : str
        ``"scan"``: has a plan, poses and frames; ``"import"``: has samples from a file.
    """

    def __init__(self, path: Path, journal: Journal) -> None:
        self.path = path
        self._journal = journal
        self.kind: Kind = "scan" if self.attributes.get("kind") == "scan" else "import"

    @classmethod
    def create(
        cls, path: str | Path, *, kind: Kind, documents: Mapping[str, str], attributes: Mapping[str, str] | None = None
    ) -> Run:
        """Make a new run.

        Parameters
        ----------
        path : path
            A folder that does not exist, or has no run in it.
        kind : {"scan", "import"}
        documents : mapping of str to str
            Texts that the run was made from, such as ``rig.toml`` and ``plan.toml``, kept in the first transaction.
        attributes : mapping of str to str, optional
            Seed, software versions, material, ...

        Raises
        ------
        DatasetError
            If there is a run already, or the folder cannot be written.
        """
        path = Path(path)
        if (path / DATABASE).exists():
            raise DatasetError(f"{path} has a run already; `gonio resume {path}` goes on with it, or give another --out")
        try:
            (path / "frames").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DatasetError(f"{path} cannot be made: {error.strerror}; give another --out") from error
        Journal.create(path / DATABASE, documents, {**(attributes or {}), "kind": kind})
        return cls.open(path)

    @classmethod
    def open(cls, path: str | Path) -> Run:
        """Open a run.

        Raises
        ------
        DatasetError
            If there is none, it is not gonio's, or a newer gonio made it.
        """
        path = Path(path)
        if not (path / DATABASE).is_file():
            raise DatasetError(
                f"{path} has no run ({DATABASE} is missing); give the folder of `gonio scan` or `gonio import`"
            )
        journal = Journal.open(path / DATABASE)
        try:
            return cls(path, journal)
        except BaseException:
            journal.close()
            raise

    def close(self) -> None:
        """Close the journal."""
        self._journal.close()

    def __enter__(self) -> Run:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    @contextmanager
    def lock(self) -> Iterator[None]:
        """A context in which this process alone scans into the run.

        Raises
        ------
        DatasetError
            On entering, if another process does; the message names it.
        """
        lock = FileLock(self.path / "scan.lock")
        try:
            lock.acquire()
        except HeldError as holder:
            raise DatasetError(
                f"{self.path} is being scanned by {holder}; wait for it to end, or stop it with Ctrl-C"
            ) from None
        except OSError as error:
            raise DatasetError(
                f"{self.path / 'scan.lock'} cannot be written: {error.strerror}; check the folder's permissions"
            ) from error
        try:
            yield
        finally:
            lock.release()

    # -- documents and attributes

    @property
    def documents(self) -> dict[str, str]:
        """All documents by name."""
        return {name: text for name, text, _ in self._journal.rows("document")}

    def document(self, name: str) -> str:
        """The text of a document, such as ``"rig.toml"``."""
        documents = self.documents
        if name not in documents:
            raise DatasetError(f"{self.path} has no document {name}; it has: {', '.join(sorted(documents)) or 'none'}")
        return documents[name]

    @property
    def attributes(self) -> dict[str, str]:
        """All attributes by name."""
        return {row[0]: row[1] for row in self._journal.rows("attribute")}

    def set_attribute(self, name: str, value: str) -> None:
        """Set an attribute, anew or again."""
        with self._journal.transaction() as db:
            db.execute("DELETE FROM attribute WHERE name = ?", (name,))
            insert(db, "attribute", name, value)

    # -- the journal

    def begin_session(self, record: Mapping[str, object]) -> int:
        """Note a start of the scan, with what the rig says of itself; returns the session's number, from 0."""
        with self._journal.transaction() as db:
            number = int(db.execute("SELECT count(*) FROM session").fetchone()[0])
            insert(db, "session", number, to_json(dict(record)))
        return number

    def sessions(self) -> list[dict[str, Any]]:
        """What was noted at each start."""
        return [json.loads(text) for _, text in self._journal.rows("session")]

    def commit_pose(self, record: PoseRecord, frames: Sequence[Frame]) -> None:
        """Commit a completed pose with its frames.

        Raises
        ------
        DatasetError
            If the pose or a label was committed before, or the disk refuses.
        """
        with self._commit(_pose_file(record.index), frames) as db:
            insert(db, "pose", record.index, to_json(record))

    def commit_block(self, record: BlockRecord, frames: Sequence[Frame]) -> None:
        """Commit a completed block of dark or white frames; as `commit_pose`."""
        with self._commit(_block_file(record.kind, record.number), frames) as db:
            insert(db, "block", record.kind, record.number, to_json(record))

    def complete_poses(self) -> set[int]:
        """Indices of the committed poses."""
        return {int(index) for (index,) in self._journal.query("SELECT idx FROM pose")}

    def poses(self) -> list[PoseRecord]:
        """All committed poses, by index."""
        return [from_json(PoseRecord, text) for _, text in self._journal.rows("pose")]

    def blocks(self, kind: str) -> list[BlockRecord]:
        """All committed blocks of a kind, ``"dark"`` or ``"white"``, by number."""
        return [from_json(BlockRecord, text) for *_, text in self._journal.rows("block", "kind = ?", kind)]

    def frames(self, pose: int) -> list[Frame]:
        """Frames of a pose, in the order of its exposures; each checked against its hash."""
        return self._frames(_pose_file(pose))

    def block_frames(self, kind: str, number: int) -> list[Frame]:
        """Frames of a block in the order taken: of a white block repeat by repeat, in each all exposures."""
        return self._frames(_block_file(kind, number))

    # -- samples

    def write_samples(self, samples: BRDFSamples) -> None:
        """Store the samples of the run, in place of earlier ones, in one transaction."""
        shared = [[s.name, s.u, s.u_sample, s.unit] for s in samples.shared]
        header = json.dumps({"shared": shared, "attributes": dict(samples.attributes)}).encode()
        with self._journal.transaction() as db:
            db.execute("DELETE FROM sample_array")
            insert(db, "sample_array", "header", "json", "[]", header)
            for name in _sample_arrays():
                array = np.ascontiguousarray(getattr(samples, name))
                portable = array.dtype.newbyteorder("<")
                data = array.astype(portable).tobytes()
                insert(db, "sample_array", name, portable.str, json.dumps(array.shape), data)

    def read_samples(self) -> BRDFSamples:
        """The samples as they were written, bit by bit.

        Raises
        ------
        DatasetError
            If there are none yet, or they are damaged.
        """
        rows = {name: (dtype, shape, data) for name, dtype, shape, data in self._journal.rows("sample_array")}
        if not rows:
            todo = f"`gonio reduce {self.path}` makes them" if self.kind == "scan" else "import the file again"
            raise DatasetError(f"{self.path} has no samples yet; {todo}")
        try:
            header = json.loads(rows["header"][2])
            arrays: dict[str, Any] = {}
            for name in _sample_arrays():
                dtype, shape, data = rows[name]
                stored = np.frombuffer(data, dtype=dtype).reshape(json.loads(shape))
                arrays[name] = stored.astype(stored.dtype.newbyteorder("="))
            shared = tuple(SharedError(*values) for values in header["shared"])
            return BRDFSamples(**arrays, shared=shared, attributes=header["attributes"])
        except (KeyError, ValueError, TypeError) as error:
            raise DatasetError(f"{self.path}: the samples cannot be read ({error}); write them again") from error

    def has_samples(self) -> bool:
        """Whether samples were written."""
        return bool(self._journal.query("SELECT 1 FROM sample_array LIMIT 1"))

    # -- derived files

    @property
    def channels_path(self) -> Path:
        """The samples in all channels, of a run that was imported from a file with several."""
        return self.path / "channels.nc"

    @property
    def table_path(self) -> Path:
        """The tabulated BRDF."""
        return self.path / "table.nc"

    @property
    def posterior_path(self) -> Path:
        """The fit."""
        return self.path / "posterior.nc"

    @property
    def log_path(self) -> Path:
        """The log."""
        return self.path / "gonio.log"

    @property
    def exports(self) -> Path:
        """Folder of exported files, made if it is not there."""
        folder = self.path / "exports"
        folder.mkdir(exist_ok=True)
        return folder

    # -- checking

    def verify(self) -> list[str]:
        """Everything that is wrong with the run; empty if nothing is. Reads every frame file."""
        problems = self._journal.problems()
        try:
            named = {_pose_file(index) for (index,) in self._journal.query("SELECT idx FROM pose")}
            named |= {_block_file(kind, number) for kind, number in self._journal.query("SELECT kind, number FROM block")}
            files = self._journal.query("SELECT name, sha256, frames FROM file ORDER BY name")
            listed = dict(self._journal.query("SELECT file, count(*) FROM frame GROUP BY file"))
        except DatasetError as error:
            return [*problems, str(error)]
        problems += [f"frames/{name}: the journal lacks its entry" for name in sorted(named - {file[0] for file in files})]
        for name, sha256, count in files:
            if Path(name).name != name:
                problems.append(f"{DATABASE}: the file name {name!r} leads out of the run")
                continue
            try:
                stack = frame_files.read_stack(self.path / "frames" / name, sha256)
            except (DatasetError, ValueError) as error:
                problems.append(str(error))
                continue
            if not len(stack) == count == listed.get(name, 0):
                problems.append(
                    f"frames/{name}: {count} frames were taken, it has {len(stack)}, {listed.get(name, 0)} are listed"
                )
        return problems

    # -- inside

    @contextlib.contextmanager
    def _commit(self, name: str, frames: Sequence[Frame]) -> Iterator[sqlite3.Connection]:
        """Frames to the disk, then their rows and the caller's in one transaction."""
        if self._journal.query("SELECT 1 FROM file WHERE name = ?", name):
            raise DatasetError(f"{self.path}: {name.removesuffix('.npy')} was committed before; it is not written again")
        sha256 = frame_files.write_stack(self.path / "frames" / name, [frame.data for frame in frames])
        with self._journal.transaction() as db:
            insert(db, "file", name, sha256, len(frames))
            for position, frame in enumerate(frames):
                about = {f.name: getattr(frame, f.name) for f in fields(frame) if f.name not in ("data", "label")}
                insert(db, "frame", frame.label, name, position, to_json(about))
            yield db

    def _frames(self, name: str) -> list[Frame]:
        file = self._journal.rows("file", "name = ?", name)
        if not file:
            raise DatasetError(f"{self.path}: {name.removesuffix('.npy')} is not in the journal; it was not completed")
        stack = frame_files.read_stack(self.path / "frames" / name, file[0][1])
        rows = sorted(self._journal.rows("frame", "file = ?", name), key=lambda row: int(row[2]))
        if len(rows) != len(stack):
            raise DatasetError(f"{self.path}: frames/{name} has {len(stack)} frames, the journal lists {len(rows)}")
        return [Frame(data=stack[position], label=label, **json.loads(about)) for label, _, position, about in rows]


def _pose_file(index: int) -> str:
    return f"pose-{index:06d}.npy"


def _block_file(kind: str, number: int) -> str:
    return f"{kind}-{number:04d}.npy"


def _sample_arrays() -> list[str]:
    return [f.name for f in fields(BRDFSamples) if f.name not in ("shared", "attributes")]
