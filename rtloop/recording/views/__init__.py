"""What is made of a recording: summary, pictures, pages, tables."""
