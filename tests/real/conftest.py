"""The folder of real recordings, named by ODOMAP_DATA."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Return the folder; skip where it is absent, but fail in CI."""
    name = os.environ.get("ODOMAP_DATA", "")
    folder = Path(name)
    if name and folder.is_dir():
        return folder
    reason = (
        f"ODOMAP_DATA={name}: no such folder" if name else "set ODOMAP_DATA to the real recordings"
    )
    if os.environ.get("CI"):
        pytest.fail(f"{reason}; in CI they must be there")
    pytest.skip(reason)
