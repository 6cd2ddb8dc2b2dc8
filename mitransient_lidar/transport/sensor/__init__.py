"""The receiver: pixels, fields of view, blur and sampling."""
