"""Aircraft: the truth that flies, and what disturbs it; no network in here."""
