"""What a user says, checked, and what is built from it: everything that can fail, fails here."""
