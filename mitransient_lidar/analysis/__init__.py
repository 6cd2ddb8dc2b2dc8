"""Analysis of results: datasets in, datasets out, without Mitsuba."""
