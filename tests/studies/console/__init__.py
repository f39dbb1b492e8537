"""The console's page in a real browser, beside a flight that goes on."""
