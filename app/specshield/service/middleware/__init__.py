"""Around every request, as plain ASGI (Starlette's `@app.middleware` costs most of the throughput)."""
