"""Fault detection, isolation and recovery: facts become events, events reactions, reactions a mode."""
