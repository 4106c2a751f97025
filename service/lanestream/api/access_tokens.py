"""Access tokens: what a web page uses instead of an API key.

A key is exchanged for a token that is valid for minutes, a JSON Web Token (RFC 7519) signed by HMAC-SHA256. Its subject
is the name of the key. A page that leaks its token leaks a few minutes of access, not the key.
"""

from __future__ import annotations

import secrets
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Self

import jwt

from lanestream.errors import UnauthorizedError

if TYPE_CHECKING:
    from lanestream.settings import Settings

_ALGORITHM: Final = "HS256"
_SECRET_BYTES: Final = 32
# The clocks of replicas differ by less than this, in seconds.
_LEEWAY_S: Final = 5.0


@dataclass(frozen=True)
class TokenSigner:
    """Signs and verifies access tokens, which expire after `lifetime_s` seconds."""

    secret: str = field(repr=False)
    lifetime_s: float

    @classmethod
    def from_settings(cls, settings: Settings) -> Self:
        """Returns the signer for these settings. Without `token_secret`, only this process accepts its tokens."""
        given = settings.token_secret
        return cls(secrets.token_hex(_SECRET_BYTES) if given is None else given.get_secret_value(), settings.token_s)

    def sign(self, name: str) -> str:
        """Returns a token for the caller `name`. It is valid in a header and as a WebSocket subprotocol."""
        now = time.time()
        return jwt.encode({"sub": name, "iat": int(now), "exp": int(now + self.lifetime_s)}, self.secret, _ALGORITHM)

    def verify(self, token: str) -> str | None:
        """Returns the caller's name; None if this is not a token that was signed with the same secret.

        Raises UnauthorizedError if the token has expired.
        """
        try:
            claims: dict[str, Any] = jwt.decode(
                token, self.secret, algorithms=[_ALGORITHM], leeway=_LEEWAY_S, options={"require": ["sub", "exp"]}
            )
        except jwt.ExpiredSignatureError:
            raise UnauthorizedError(
                "this access token has expired", "get another one from POST /v1/tokens with an API key"
            ) from None
        except jwt.InvalidTokenError:
            return None
        return str(claims["sub"])
