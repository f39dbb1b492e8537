"""Security of the link, CCSDS 355.0-B-2: keys, counters, and frames that nobody else can make or repeat."""
