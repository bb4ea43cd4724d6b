"""The stages of a survey, one module a subject: each says what it wants stored, and how that is made."""
