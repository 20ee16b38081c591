"""Other programs' files: measurements that come in, recordings that go out."""
