"""Streams and their sessions, without sockets: protocol, registry, stores."""
