"""The laser's beam: profiles and sampling."""
