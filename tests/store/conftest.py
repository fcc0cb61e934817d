"""What several tests of the store share: a site of two flights, of plain colours."""

import shutil
from pathlib import Path

import pytest
from fake_flights import mapped_site


@pytest.fixture(scope="session")
def two_flights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site that nobody changes, each flight with a comparison."""
    return mapped_site(tmp_path_factory.mktemp("flown") / "site", 2)


@pytest.fixture
def site(two_flights: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(two_flights, tmp_path / "site"))
