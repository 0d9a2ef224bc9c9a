"""Server that keeps lifted runs in memory for the web page, the HTTP API and MCP.

* `runs`: open runs with the data that their pages share, within a memory limit.
* `protocol`, `permalink`: messages between a page and the server, colors included, and links that store a query and a
  camera.
* `session`, `describe`: session of one page, and the content of the messages that it sends to the page.
* `schema`, `http_api`: request and response types of the HTTP API, its routes and its OpenAPI document.
* `app`, `host_check`: Starlette application with request checks and limits.
* `client`, `mcp_tools`: Python client, `normlift_ns.connect`, and MCP tools for agents.
"""
