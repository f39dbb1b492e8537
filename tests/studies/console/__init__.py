"""The console's page in a real browser, beside a running flight."""
