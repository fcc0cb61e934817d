"""The vocabulary: frozen records that every other room speaks in; no algorithms."""
