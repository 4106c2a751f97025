"""Loading a network where it runs best, or where a user wants it to run."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

from lanestream.errors import ModelError, ProviderError
from lanestream.inference.loaded_model import LoadedModel, runtime_message
from lanestream.inference.providers import AUTO, CPU, DEFAULT_OPTIONS, Installed, RuntimeOptions, attempts


def load_model(
    path: Path, provider: str = AUTO, options: RuntimeOptions = DEFAULT_OPTIONS, installed: Installed | None = None
) -> LoadedModel:
    """Loads the network in the file at `path`; `auto` takes the first provider that works and records what failed.

    `installed` defaults to what this machine has. Raises ModelError for a file that cannot be served, ProviderError if
    a requested provider cannot be used: another one never replaces it silently.
    """
    installed = installed or Installed.here()
    failed: list[str] = []
    fell_back = False
    for spec, why in attempts(provider, installed):
        is_installed = False
        try:
            spec.require(installed)
            is_installed = True
            model = spec.load(path, options, "; ".join([*failed, why]))
        except ProviderError as error:
            if provider != AUTO or spec is CPU:
                raise
            failed.append(error.message)
            fell_back |= is_installed
        except ModelError:
            raise
        except Exception as error:  # nothing that is wrong with a file may look like a fault of this program
            raise ModelError(
                f"{path} can't be loaded: {runtime_message(error)}", "give a file exported by `lanestream export`"
            ) from error
        else:
            model.placement = replace(model.placement, fell_back=fell_back)
            with path.open("rb") as file:
                model.sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            return model
    raise AssertionError("the CPU is always tried last")
