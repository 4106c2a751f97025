"""Streams and their sessions without sockets: the stream protocol, the session registry and the session stores."""
