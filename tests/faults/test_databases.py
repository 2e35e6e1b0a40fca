"""PostgreSQL that crashes or loses its connections: nobody is told what is not so."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.faults.databases import commits_cut, crashes
from tests.postgres import Cluster, NoPostgres, cluster

pytestmark = [pytest.mark.compiled, pytest.mark.postgres]


@pytest.fixture(scope="module")
def durable_postgres() -> Iterator[Cluster]:
    """Return a private server, to be restarted."""
    try:
        with cluster(durable=True) as server:
            yield server
    except NoPostgres as error:
        if os.environ.get("CI") == "true":
            raise
        pytest.skip(str(error))


def test_a_database_that_crashes_under_load_is_waited_for(tmp_path: Path, durable_postgres: Cluster) -> None:
    verdict = crashes(tmp_path, 1, lambda _: None, durable_postgres)
    assert verdict.wrong == []
    assert (len(verdict.back_s), verdict.verifications) == (1, 1)


def test_a_connection_that_breaks_at_a_commit_brings_no_wrong_answer(tmp_path: Path, durable_postgres: Cluster) -> None:
    verdict = commits_cut(tmp_path, 1, lambda _: None, durable_postgres)
    assert verdict.wrong == []
    assert "cut" in verdict.remarks[-1]
