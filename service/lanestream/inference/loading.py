"""Loading a network where it runs best, or where it was asked to run."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

from lanestream.errors import ProviderError
from lanestream.inference.loaded_model import LoadedModel
from lanestream.inference.onnx_model import OnnxModel
from lanestream.inference.openvino_model import OpenVinoModel
from lanestream.inference.providers import Loadable, Offer, attempts, offered, require
from lanestream.runtime import DEFAULT_OPTIONS, Provider, RuntimeOptions


def load_model(
    path: Path, provider: Provider = "auto", options: RuntimeOptions = DEFAULT_OPTIONS, offer: Offer | None = None
) -> LoadedModel:
    """The network in the file at `path`; `auto` takes the first provider that can be had, and says what it passed over.

    `offer` is what is installed, found out where None. Raises ModelError for a file that can't be served, ProviderError
    where the provider that was asked for can't be had: another one never stands in for it.
    """
    offer = offer or offered()
    passed_over: list[str] = []
    fell_back = False
    for name, why in attempts(provider, offer).items():
        installed = False
        try:
            require(name, offer)
            installed = True
            network = _load(path, name, options, "; ".join([*passed_over, why]))
        except ProviderError as error:
            if provider != "auto" or name == "cpu":
                raise
            passed_over.append(error.message)
            fell_back |= installed
        else:
            network.placement = replace(network.placement, fell_back=fell_back)
            network.sha256 = _sha256(path)
            return network
    raise AssertionError("the CPU is the last one tried")


def _load(path: Path, provider: Loadable, options: RuntimeOptions, reason: str) -> LoadedModel:
    if provider == "openvino":
        return OpenVinoModel.load(path, options, reason)
    return OnnxModel.load(path, provider, options, reason)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
