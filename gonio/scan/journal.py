"""The journal of a run: one SQLite file in which every row has its own CRC-32.

WAL and ``synchronous=FULL``: what has been committed is there after ``kill -9`` and after a power cut [1]_. Transactions
are short, and a second process that reads meanwhile is served. It knows rows, and nothing of what they mean.

References
----------
.. [1] SQLite, "Write-Ahead Logging" and "PRAGMA synchronous", https://www.sqlite.org/wal.html,
   https://www.sqlite.org/pragma.html#pragma_synchronous
"""

from __future__ import annotations

import contextlib
import hashlib
import sqlite3
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gonio.errors import DatasetError
from gonio.scan.frames import sync_folder

APPLICATION_ID = 0x676F6E69  # "goni"
SCHEMA_VERSION = 1
DATABASE = "run.sqlite"
BUSY_TIMEOUT_MS = 10_000

TABLES: dict[str, tuple[str, ...]] = {  # columns before crc
    "document": ("name TEXT", "text TEXT", "sha256 TEXT"),
    "attribute": ("name TEXT", "value TEXT"),
    "session": ("number INTEGER", "record TEXT"),
    "pose": ("idx INTEGER", "record TEXT"),
    "block": ("kind TEXT", "number INTEGER", "record TEXT"),
    "file": ("name TEXT", "sha256 TEXT", "frames INTEGER"),
    "frame": ("label TEXT", "file TEXT", "position INTEGER", "record TEXT"),
    "sample_array": ("name TEXT", "dtype TEXT", "shape TEXT", "data BLOB"),
}
KEYS = {"block": 2}  # columns of the primary key, where it is not 1


class Journal:
    """An open journal."""

    def __init__(self, file: Path, connection: sqlite3.Connection) -> None:
        self.file = file
        self._db = connection

    @staticmethod
    def create(file: Path, documents: Mapping[str, str], attributes: Mapping[str, str]) -> None:
        """Make a journal with its first rows: there in full, or not at all.

        Raises
        ------
        DatasetError
            If there is one already, or the folder cannot be written.
        """
        new = file.with_name(file.name + ".new")
        try:
            for suffix in ("", "-wal", "-shm", "-journal"):
                new.with_name(new.name + suffix).unlink(missing_ok=True)
        except OSError as error:
            raise DatasetError(f"{file.parent} cannot be written: {error.strerror}; give another --out") from error
        with translated(file), contextlib.closing(sqlite3.connect(new, isolation_level=None)) as db:
            db.execute("PRAGMA synchronous=FULL")
            db.execute("BEGIN IMMEDIATE")
            for table, columns in TABLES.items():
                key = ", ".join(column.split()[0] for column in columns[: KEYS.get(table, 1)])
                needed = ", ".join(f"{column} NOT NULL" for column in (*columns, "crc INTEGER"))
                db.execute(f"CREATE TABLE {table} ({needed}, PRIMARY KEY ({key}))")
            for name, text in documents.items():
                insert(db, "document", name, text, sha256(text))
            for name, value in attributes.items():
                insert(db, "attribute", name, value)
            db.execute(f"PRAGMA application_id={APPLICATION_ID}")
            db.execute(f"PRAGMA user_version={SCHEMA_VERSION}")
            db.execute("COMMIT")
        try:
            file.hardlink_to(new)  # fails if the name is taken: of two processes exactly one wins
            new.unlink()
        except FileExistsError:
            new.unlink(missing_ok=True)
            raise DatasetError(f"{file.parent} has a run already, made a moment ago; give another --out") from None
        except OSError:  # a file system without hard links
            new.rename(file)
        sync_folder(file.parent)
        sync_folder(file.absolute().parent.parent)

    @classmethod
    def open(cls, file: Path) -> Journal:
        """Open a journal.

        Raises
        ------
        DatasetError
            If it is not gonio's, a newer gonio made it, or the file system cannot hold it.
        """
        with translated(file):
            db = sqlite3.connect(file, isolation_level=None)
            try:
                db.execute(f"PRAGMA busy_timeout={BUSY_TIMEOUT_MS}")
                application = db.execute("PRAGMA application_id").fetchone()[0]
                version = db.execute("PRAGMA user_version").fetchone()[0]
                if application != APPLICATION_ID:
                    raise DatasetError(f"{file} is a database of another program (application id {application}), no run")
                if version > SCHEMA_VERSION:
                    raise DatasetError(
                        f"{file} has schema version {version}, this gonio knows {SCHEMA_VERSION}; use a newer one"
                    )
                mode = db.execute("PRAGMA journal_mode=WAL").fetchone()[0]
                if mode != "wal":
                    raise DatasetError(f"{file}: the file system allows no write-ahead log (mode {mode}); use a local disk")
                db.execute("PRAGMA synchronous=FULL")
                return cls(file, db)
            except BaseException:
                db.close()
                raise

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    @contextlib.contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """A transaction that commits if nothing is raised in it."""
        with translated(self.file):
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield self._db
            except BaseException:
                self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")

    def rows(self, table: str, where: str = "", *values: object) -> list[list[Any]]:
        """Rows of a table by key, each checked against its CRC.

        Raises
        ------
        DatasetError
            If a row was changed.
        """
        found = []
        condition = f" WHERE {where}" if where else ""
        with translated(self.file):
            for *row, crc in self._db.execute(f"SELECT * FROM {table}{condition} ORDER BY 1, 2", values):
                if _crc(row) != crc:
                    raise DatasetError(
                        f"{self.file}: {changed(table, row, crc)}; run `gonio verify`, restore it from a copy"
                    )
                found.append(row)
        return found

    def query(self, sql: str, *values: object) -> list[tuple[Any, ...]]:
        """Rows of any query, unchecked."""
        with translated(self.file):
            return list(self._db.execute(sql, values))

    def problems(self) -> list[str]:
        """What is wrong inside the file: its structure, a row's CRC, a document's hash."""
        found = []
        try:
            found += [text for (text,) in self._db.execute("PRAGMA integrity_check") if text != "ok"]
            for table in TABLES:
                for *row, crc in self._db.execute(f"SELECT * FROM {table}"):
                    if _crc(row) != crc:
                        found.append(changed(table, row, crc))
                    elif table == "document" and sha256(row[1]) != row[2]:
                        found.append(f"document {row[0]} does not match its SHA-256")
        except sqlite3.DatabaseError as error:
            found.append(str(error))
        return [f"{self.file.name}: {text}" for text in found]


def insert(db: sqlite3.Connection, table: str, *values: Any) -> None:
    """Insert a row with its CRC."""
    db.execute(f"INSERT INTO {table} VALUES ({', '.join('?' * (len(values) + 1))})", (*values, _crc(values)))


def changed(table: str, row: Sequence[Any], crc: int) -> str:
    """Says of a row that it is not what was written."""
    name = " ".join(str(value)[:60] for value in row[: KEYS.get(table, 1)])
    return f"{table} {name} was changed: its CRC-32 is {_crc(row):08x}, not {crc:08x}"


def sha256(text: str) -> str:
    """SHA-256 of a text in UTF-8."""
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def _crc(values: Sequence[Any]) -> int:
    crc = 0
    for value in values:
        data = value if isinstance(value, bytes) else str(value).encode("utf-8", "surrogatepass")
        crc = zlib.crc32(f"{type(value).__name__}:{len(data)}:".encode(), crc)
        crc = zlib.crc32(data, crc)
    return crc


@contextlib.contextmanager
def translated(file: Path) -> Iterator[None]:
    """SQLite's errors as ours."""
    try:
        yield
    except sqlite3.IntegrityError as error:
        raise DatasetError(f"{file}: a record was committed before ({error}); nothing was written") from error
    except sqlite3.OperationalError as error:
        raise DatasetError(f"{file}: {error}; check the disk, its free space and who else uses the run") from error
    except sqlite3.DatabaseError as error:
        raise DatasetError(f"{file} is damaged or no run: {error}; restore it from a copy") from error
