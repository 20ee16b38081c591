"""Views of a recording: summary, pictures, pages, tables."""
