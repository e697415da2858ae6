"""How an estimate enters torch."""
