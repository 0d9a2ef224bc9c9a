"""One warm server for lifted runs: the web page with a session per browser page, an HTTP API, and MCP.

* `runs`: open runs with everything that their pages share; several of them within a memory limit.
* `coloring`: one byte per drawn Gaussian and a palette, which color the geometry that a page already has.
* `protocol`, `permalink`: messages of a page; links that carry a query and a camera.
* `session`: actions of one page on its state, and messages to the page; `describe`: their content.
* `schema`, `http_api`: requests and answers of the HTTP API, and its OpenAPI document.
* `app`, `host_check`: the Starlette application, its checks and limits.
* `client`: `normlift_ns.connect`. `mcp_tools`: the same verbs for agents.
"""
