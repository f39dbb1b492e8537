"""Who may use the console: the browser that opened an address with a token, and no other page.

A token is good for one browser: the first request with it gets a cookie and the token is replaced. So an
address that another user of the machine finds later, for example in the list of processes, opens nothing.
Host and Origin are checked as well, because a name that was rebound to loopback (DNS rebinding) and a page of
another origin reach the console through the operator's own browser.
"""

from __future__ import annotations

import hmac
import re
import secrets
from collections.abc import Callable, Mapping

_RANDOM_BYTES = 32
_OWN_HOST = re.compile(r"(127\.0\.0\.1|localhost)(:[0-9]{1,5})?")


class Access:
    """The token of the next browser and the cookies of those that came before."""

    def __init__(self, announce: Callable[[str], object]) -> None:
        """Make a token; `announce` gets each one that replaces a used token."""
        self._announce = announce
        self._sessions: list[str] = []
        self.token = secrets.token_urlsafe(_RANDOM_BYTES)

    def exchange(self, token: str) -> str | None:
        """Return the cookie of a new session for the current token, None for any other text."""
        if not _equal(token, self.token):
            return None
        self._sessions.append(secrets.token_urlsafe(_RANDOM_BYTES))
        self.token = secrets.token_urlsafe(_RANDOM_BYTES)
        self._announce(self.token)
        return self._sessions[-1]

    def admits(self, cookie: str) -> bool:
        """Return whether a cookie is one of a session."""
        return any([_equal(cookie, session) for session in self._sessions])


def foreign(headers: Mapping[str, str], origin_required: bool) -> str:
    """Return why a request does not come from the console's own page, empty if it does.

    Browsers state the origin of each POST and each WebSocket, so these must have one (`origin_required`).
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    if not _OWN_HOST.fullmatch(host):
        return "this console answers on loopback only"
    if origin is None:
        return (
            "this console answers its own page only: the request states no Origin" if origin_required else ""
        )
    return "" if origin == f"http://{host}" else "this console answers its own page only"


def _equal(one: str, other: str) -> bool:
    return hmac.compare_digest(one.encode(errors="replace"), other.encode())
