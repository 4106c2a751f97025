"""Shows URLs without their secrets, and makes the login of a camera's URL readable for FFmpeg."""

from __future__ import annotations

import re
from typing import Final
from urllib.parse import quote

# What may stand in a login without being escaped. A "%" is kept, because the login may be escaped already.
_SAFE_IN_LOGIN: Final = "%!$&'()*+,;=~-._"
_END_OF_ADDRESS: Final = re.compile(r"[/?#]")


def redact_url(url: str) -> str:
    """Returns the URL without anything that may be secret, for people.

    The login before the address is left out, also if it holds characters that should be escaped, and so is everything
    from the first parameter on, because many cameras take the login there: `?user=U&password=P`, `/user=U_password=P`.
    If it is not clear where the login ends, the address is left out too.
    """
    scheme, separator, rest = url.partition("://") if "://" in url else ("", "", url)
    login, at, address = rest.rpartition("@")
    host = _END_OF_ADDRESS.split(rest, maxsplit=1)[0]
    if at and ("@" in host or ":" in host):
        # This "@" may also be in a parameter, as in `?password=p@ss`. What follows it would then be secret.
        rest = "?..." if re.search(r"\?.*=", login) else address
    shown = re.split(r"[?#=;&]", rest, maxsplit=1)
    return f"{scheme}{separator}{shown[0]}{'...' if len(shown) > 1 else ''}"


def redact_urls(text: str) -> str:
    """Returns `text` with every URL in it redacted. Takes an URL to end at the next space or quotation mark."""
    return re.sub(r"[a-zA-Z][a-zA-Z0-9+.-]*://[^\s'\"]+", lambda match: redact_url(match[0]), text)


def with_escaped_login(url: str) -> str:
    """Returns the URL of a camera with the user name and the password escaped, as FFmpeg needs it.

    A "/", "?" or "#" in a password ends the address if it is not escaped, so that FFmpeg would look for a host that
    has the name of the user.
    """
    scheme, separator, rest = url.partition("://")
    host = _END_OF_ADDRESS.split(rest, maxsplit=1)[0]
    port = host.rpartition(":")[2] if ":" in host else "0"
    if "@" in host:
        end = host.rindex("@")
    elif "@" in rest and not port.isdecimal() and not host.endswith("]"):
        end = rest.rindex("@")
    else:
        return url
    user, colon, password = rest[:end].partition(":")
    login = f"{quote(user, safe=_SAFE_IN_LOGIN)}{colon}{quote(password, safe=_SAFE_IN_LOGIN)}"
    return f"{scheme}{separator}{login}{rest[end:]}"
