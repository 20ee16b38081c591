"""Shipped laws, one file each."""
