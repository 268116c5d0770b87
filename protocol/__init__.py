"""The words robots share: types, their exact bytes, and the table of channels.  No I/O."""
