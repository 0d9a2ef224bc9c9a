"""HTTP API."""


def api_routes(server):
    return []
