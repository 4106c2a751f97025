from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from pydantic import SecretStr

from lanestream.cluster.options import ClusterOptions, check_settings, parse_replicas, replica_settings
from lanestream.cluster.ray_variables import RAY_VARIABLES, set_ray_variables
from lanestream.errors import SettingsError
from lanestream.settings import Settings

PAGE = (Path(__file__).parents[4] / "docs/cluster.md").read_text()


@pytest.mark.parametrize(("text", "expected"), [("3", (3, 3)), ("1..4", (1, 4))])
def test_replicas(text: str, expected: tuple[int, int]) -> None:
    assert parse_replicas(text) == expected


@pytest.mark.parametrize("text", ["", "x", "1..", "..2", "-1", "1.5", "1...3", "1..2..3", "٣", "1" * 30])
def test_bad_replicas(text: str) -> None:
    with pytest.raises(ValueError, match="is neither a number nor a range"):
        parse_replicas(text)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"min_replicas": 0}, "min_replicas = 0: input should be greater than or equal to 1"),
        ({"max_replicas": "many"}, "max_replicas = 'many': input should be a valid integer"),
        ({"min_replicas": 3, "max_replicas": 2}, "max_replicas = 2 is less than min_replicas = 3"),
        ({"cpus": 0}, "cpus = 0: input should be greater than 0"),
        ({"replicas": 2}, "replicas is not an option of a cluster"),
    ],
)
def test_bad_options(values: dict[str, object], message: str) -> None:
    with pytest.raises(SettingsError) as caught:
        ClusterOptions.parse(values)
    assert caught.value.message.startswith(message)


def test_more_than_one_replica_needs_redis() -> None:
    two = ClusterOptions(max_replicas=2)
    check_settings(Settings(), ClusterOptions())
    check_settings(Settings(redis_url=SecretStr("redis://x")), two)
    with pytest.raises(SettingsError, match="more than one replica needs Redis"):
        check_settings(Settings(), two)
    with pytest.raises(SettingsError, match="Ray's proxy does not use it"):
        check_settings(Settings(tls_certificate=Path("certificate.pem")), ClusterOptions())


@pytest.mark.parametrize(
    ("given", "options", "expected"),
    [
        ({}, {}, (1, 2, 1)),
        ({}, {"cpus": 0.5}, (1, 2, 1)),
        ({}, {"cpus": 4}, (4, 1, 1)),
        ({}, {"cpus": 4, "gpus": 1}, (1, 5, 2)),
        ({"processes": 0}, {"cpus": 4}, (0, 5, 2)),
        ({"processes": 2, "threads": 3, "inference_threads": 7}, {"cpus": 4}, (2, 3, 7)),
    ],
)
def test_work_follows_from_what_a_replica_reserves(
    given: dict[str, Any], options: dict[str, Any], expected: tuple[int, int, int]
) -> None:
    settings = replica_settings(Settings(**given), ClusterOptions(**options))
    assert (settings.processes, settings.threads, settings.inference_threads) == expected
    assert settings.runtime_options.threads == expected[2]


def test_replicas_share_one_secret() -> None:
    made = replica_settings(Settings(), ClusterOptions()).token_secret
    assert made is not None
    assert len(made.get_secret_value()) >= 32
    given = Settings(token_secret=SecretStr("s" * 32))
    assert replica_settings(given, ClusterOptions()).token_secret == given.token_secret


def test_variables_that_are_set_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    environment = {"RAY_SERVE_ENABLE_HA_PROXY": "1"}
    monkeypatch.setattr("os.environ", environment)
    set_ray_variables()
    assert environment.items() > {**RAY_VARIABLES, "RAY_SERVE_ENABLE_HA_PROXY": "1"}.items()


def test_the_documentation_has_the_variables_and_the_options() -> None:
    for name, value in RAY_VARIABLES.items():
        assert re.search(rf"^export {name}={value}\b", PAGE, re.MULTILINE), name
    for name in ClusterOptions.model_fields:
        assert f"`{name}`" in PAGE
