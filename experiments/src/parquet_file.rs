//! `runs.parquet`: the same rows as `runs.csv`, columns of numbers as doubles.

use crate::fail::Fail;
use parquet::{
    basic::{Compression, ConvertedType, Repetition, Type as Physical},
    data_type::{ByteArray, ByteArrayType, DoubleType},
    errors::ParquetError,
    file::{properties::WriterProperties, writer::SerializedFileWriter},
    schema::types::Type,
};
use rowgram::io::output;
use std::{path::Path, sync::Arc};

/// Writes rows whose first is the header. A column is of doubles where every cell that is not empty
/// is a number, otherwise of text; empty cells are null in the former.
pub(crate) fn write(path: &Path, rows: &[Vec<String>]) -> Result<(), Fail> {
    let bytes = encode(rows).map_err(|e| Fail::Failed(format!("{}: {e}", path.display())))?;
    output::write(path, true, |out| out.write_all(&bytes))?;
    Ok(())
}

fn encode(rows: &[Vec<String>]) -> Result<Vec<u8>, ParquetError> {
    let Some((header, rows)) = rows.split_first() else { return Ok(Vec::new()) };
    let numeric: Vec<bool> = (0..header.len())
        .map(|c| rows.iter().all(|row| row[c].is_empty() || row[c].parse::<f64>().is_ok()))
        .zip(header)
        .map(|(numbers, name)| numbers && name != "reason" && name != "status")
        .collect();
    let fields = header
        .iter()
        .zip(&numeric)
        .map(|(name, &numeric)| {
            let field = if numeric {
                Type::primitive_type_builder(name, Physical::DOUBLE)
                    .with_repetition(Repetition::OPTIONAL)
            } else {
                Type::primitive_type_builder(name, Physical::BYTE_ARRAY)
                    .with_converted_type(ConvertedType::UTF8)
                    .with_repetition(Repetition::REQUIRED)
            };
            field.build().map(Arc::new)
        })
        .collect::<Result<Vec<_>, _>>()?;
    let schema = Arc::new(Type::group_type_builder("runs").with_fields(fields).build()?);
    // The name of the writer is part of the file; without a version the bytes stay the same.
    let properties = WriterProperties::builder()
        .set_compression(Compression::SNAPPY)
        .set_created_by("rowgram experiments".to_owned())
        .build();
    let mut writer = SerializedFileWriter::new(Vec::new(), schema, Arc::new(properties))?;
    let mut group = writer.next_row_group()?;
    for (c, &numeric) in numeric.iter().enumerate() {
        let Some(mut column) = group.next_column()? else { break };
        if numeric {
            let values: Vec<f64> = rows.iter().filter_map(|row| row[c].parse().ok()).collect();
            let levels: Vec<i16> = rows.iter().map(|row| i16::from(!row[c].is_empty())).collect();
            column.typed::<DoubleType>().write_batch(&values, Some(&levels), None)?;
        } else {
            let values: Vec<ByteArray> =
                rows.iter().map(|row| ByteArray::from(row[c].as_str())).collect();
            column.typed::<ByteArrayType>().write_batch(&values, None, None)?;
        }
        column.close()?;
    }
    group.close()?;
    writer.into_inner()
}

#[cfg(test)]
mod tests {
    use super::*;
    use parquet::{file::reader::FileReader, file::serialized_reader::SerializedFileReader};

    #[test]
    fn what_is_written_is_read_back_and_repeats_itself() {
        let rows: Vec<Vec<String>> = [["a", "word"], ["1.5", "x"], ["", "y"], ["-2", ""]]
            .iter()
            .map(|row| row.iter().map(|&cell| cell.to_owned()).collect())
            .collect();
        let bytes = encode(&rows).unwrap();
        assert_eq!(bytes, encode(&rows).unwrap());
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("runs.parquet");
        write(&path, &rows).unwrap();
        let reader = SerializedFileReader::new(std::fs::File::open(&path).unwrap()).unwrap();
        let read: Vec<String> =
            reader.get_row_iter(None).unwrap().map(|row| row.unwrap().to_string()).collect();
        assert_eq!(read[0], "{a: 1.5, word: \"x\"}");
        assert_eq!(read[1], "{a: null, word: \"y\"}");
        assert_eq!(read.len(), 3);
    }
}
