"""Protocol, metrics, tables and pictures of policies; `study` compares methods, `stress` disturbs them."""
