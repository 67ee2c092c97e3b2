"""Where a calibration came from: what its file says of itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lasercal_gtsam.io.files import read_json, sha256_of


@dataclass(frozen=True)
class Origin:
    """Where a calibration came from, as far as it is known.

    Attributes
    ----------
    file, sha256 : name and digest of ``calibration.json``; "" where it is on no disk
    created, version : when and with which version it was made (ISO time); "" where not known
    files : file name to SHA-256 of what the spots were read from
    """

    file: str = ""
    sha256: str = ""
    created: str = ""
    version: str = ""
    files: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of_file(cls, path: str | Path) -> Origin:
        """Read it from a ``calibration.json``; DataError where that cannot be read."""
        data = read_json(Path(path))
        said: Any = data.get("provenance") if isinstance(data, dict) else None
        said = said if isinstance(said, dict) else {}
        files = said.get("files")
        return cls(
            file=Path(path).name,
            sha256=sha256_of(path),
            created=str(said.get("created", "")),
            version=str(said.get("version", "")),
            files={str(k): str(v) for k, v in files.items()} if isinstance(files, dict) else {},
        )
