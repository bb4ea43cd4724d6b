"""The Prefect server that a schedule starts: it answers its own address and its own pages, nobody else's.

Run as a process of its own: ``python -m flows.schedule.guarded_server PORT``.
"""

from __future__ import annotations

import sys
from collections.abc import Awaitable, Callable, MutableMapping, Sequence
from typing import TYPE_CHECKING, Any

from pipeline.lazy import deferred

if TYPE_CHECKING:
    import prefect.server.api.server as prefect_server
    import starlette.middleware.trustedhost as trustedhost
    import uvicorn
else:
    prefect_server = deferred("prefect.server.api.server")
    trustedhost = deferred("starlette.middleware.trustedhost")
    uvicorn = deferred("uvicorn")

Scope = MutableMapping[str, Any]
App = Callable[[Scope, Callable[[], Awaitable[Any]], Callable[[Any], Awaitable[None]]], Awaitable[None]]
HOST = "127.0.0.1"
NAMES = (HOST, "localhost")  # by which a browser of this machine may ask for it


def own_origins(port: int) -> list[str]:
    """Origins of the server's own pages, as browsers send them."""
    return [f"http://{name}:{port}" for name in NAMES]


class OwnPagesOnly:
    """Refuses what a page from elsewhere asks for (403), before the application sees it.

    A browser names the page that asks in the header ``Origin``, for every request that may change something and for web
    sockets; what comes without one is no page's, and has to know the password.
    """

    def __init__(self, app: App, origins: Sequence[str]) -> None:
        self._app, self._origins = app, [origin.encode("ascii") for origin in origins]

    async def __call__(
        self, scope: Scope, receive: Callable[[], Awaitable[Any]], send: Callable[[Any], Awaitable[None]]
    ) -> None:
        """Answer, or hand on to the application."""
        origins = [value for name, value in scope.get("headers", ()) if name == b"origin"]
        if all(origin in self._origins for origin in origins):
            await self._app(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            text = b"refused: asked for by a page of another address"
            await send({"type": "http.response.start", "status": 403, "headers": [(b"content-type", b"text/plain")]})
            await send({"type": "http.response.body", "body": text})


def guarded(app: App, port: int) -> App:
    """An application for its own address (400 else: another's DNS may point here) and its own pages alone."""
    pages: Any = OwnPagesOnly(app, own_origins(port))
    return trustedhost.TrustedHostMiddleware(pages, allowed_hosts=list(NAMES), www_redirect=False)


def main(port: int) -> None:
    """Serve until told to stop."""
    app: Any = guarded(prefect_server.create_app(final=True), port)
    uvicorn.run(app, host=HOST, port=port, log_level="warning")


if __name__ == "__main__":
    main(int(sys.argv[1]))
