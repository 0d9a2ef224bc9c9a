"""Colors, legends and figures of query results."""
