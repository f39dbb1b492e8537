"""Tests of packets, scanner, flight log, reader, export and documentation."""
