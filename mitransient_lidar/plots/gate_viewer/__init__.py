"""Self-contained web page that shows a gate stack."""
