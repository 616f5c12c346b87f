"""The page viewer.html: a trained scene in one file that a browser opens without a server."""
