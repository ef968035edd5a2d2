"""Domains. Each folder is one; no domain imports another."""
