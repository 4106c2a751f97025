"""TLS for services with a certificate of a private authority, or that ask for a certificate of the client."""

from __future__ import annotations

import ssl
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from lanestream.errors import SettingsError, one_line

# OpenSSL's code for a certificate of another host name or address (X509_V_ERR_HOSTNAME_MISMATCH and its neighbor).
_OTHER_HOST: Final = frozenset({62, 64})


def tls_context(ca_file: str | Path | None, client_certificate: str | Path | None) -> ssl.SSLContext | None:
    """Returns how to connect to a service over TLS; None for the defaults.

    `ca_file` has the certificates of the only authorities to trust, in PEM; by default those of the system are trusted.
    `client_certificate` is a PEM file with a certificate, its chain and its private key without a password. Raises
    SettingsError if a file can't be used.
    """
    if ca_file is None and client_certificate is None:
        return None
    try:
        context = ssl.create_default_context(cafile=ca_file)
    except (OSError, ssl.SSLError) as error:
        raise SettingsError(f"can't use the CA file {ca_file}: {_reason(error)}", "give certificates in PEM") from None
    if client_certificate is not None:
        try:
            # Without a function, OpenSSL would ask for the password of a key in the terminal.
            context.load_cert_chain(client_certificate, password=lambda: "")
        except (OSError, ssl.SSLError) as error:
            raise SettingsError(
                f"can't use the client certificate {client_certificate}: {_reason(error)}",
                "give a PEM file with a certificate and its private key without a password",
            ) from None
    return context


def tls_hint(error: BaseException) -> str | None:
    """Returns what to do about a connection that failed because of TLS; None if it failed for another reason."""
    found = next((each for each in _causes(error) if isinstance(each, ssl.SSLError)), None)
    # A connection that just ended may have done so for any reason.
    if found is None or isinstance(found, ssl.SSLEOFError):
        return None
    if isinstance(found, ssl.SSLCertVerificationError):
        if found.verify_code in _OTHER_HOST:
            return "use a host name or address that is in the service's certificate"
        return "trust the authority of the service's certificate with --ca-file (`ca_file`), or renew the certificate"
    if "CERTIFICATE" in (found.reason or ""):
        return "give a certificate that the service accepts with --client-certificate (`client_certificate`)"
    if found.reason in ("WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE"):
        return "use http:// instead of https://: this port does not use TLS"
    return "check the TLS settings of the service or of the proxy in front of it"


def _causes(error: BaseException) -> Iterator[BaseException]:
    """Yields an error and the errors that it came from; httpx hides the one of OpenSSL behind two others."""
    seen: BaseException | None = error
    while seen is not None:
        yield seen
        seen = seen.__cause__ or seen.__context__


def _reason(error: OSError) -> str:
    if isinstance(error, ssl.SSLError):
        return "it is not valid" if error.reason is None else one_line(error.reason).replace("_", " ").lower()
    return (error.strerror or str(error)).lower()
