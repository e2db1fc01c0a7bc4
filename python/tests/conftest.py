"""What several tests need."""

import numpy as np
import pytest

import rowgram


@pytest.fixture(scope="session")
def field() -> "rowgram.synth.Field":
    """Four short rows of plants."""
    return rowgram.synth.field("mid20", seed=3, rows=4, row_length_m=4.0)


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> "rowgram.Project":
    """A small synthetic flight with all stages done."""
    folder = tmp_path_factory.mktemp("flight") / "field"
    made = rowgram.synth.flight(folder, "small")
    assert made["photos"] >= 10 and made["plants"] > 100
    project = rowgram.Project(folder)
    project.run(until="plots")
    return project


@pytest.fixture
def rng() -> np.random.Generator:
    """Reproducible numbers."""
    return np.random.default_rng(20150624)
