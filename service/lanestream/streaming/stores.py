"""The selection of a session store. To add one, write its module and select it here."""

from __future__ import annotations

from lanestream.streaming.store import MemoryStore, SessionStore


def open_store(redis_url: str | None) -> SessionStore:
    """Returns the store at a URL; None keeps sessions in this process. Raises SettingsError for an invalid URL."""
    if redis_url is None:
        return MemoryStore()
    # The redis package is an optional extra, needed by replicated services only.
    from lanestream.streaming.redis_store import RedisStore

    return RedisStore(redis_url)
