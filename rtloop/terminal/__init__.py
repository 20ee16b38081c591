"""What the terminal shows: tables, progress, verdicts. No numbers are made here."""
