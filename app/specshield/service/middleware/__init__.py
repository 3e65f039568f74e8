"""Around every request, as plain ASGI (Starlette's `@app.middleware` costs most of the throughput)."""

from specshield.service.middleware.guard import Guard, guarded
from specshield.service.middleware.observe import Observe

__all__ = ["Guard", "Observe", "guarded"]
