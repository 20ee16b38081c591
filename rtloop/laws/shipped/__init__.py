"""The laws that come with rtloop, one file each."""
