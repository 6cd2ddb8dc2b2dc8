"""Tables of numbers as instruments, surveys and spreadsheets write them: headings, units and rows."""
